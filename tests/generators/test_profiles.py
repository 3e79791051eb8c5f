"""Names and ticks of the scenes to make."""

from __future__ import annotations

from spike4dgs.generators.profiles import PROFILES, Job


def test_names_contain_a_length_that_is_not_the_profiles():
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.5).id == "car-2-paper-500ms"
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.1).id == "car-2-paper"
    assert list(Job("car", 0, 0, "small", PROFILES["small"], 0.02).target_ticks) == list(range(20, 400, 20))


def test_a_lens_is_in_the_id_and_the_settings_and_a_pinhole_is_not():
    plain = Job("car", 0, 0, "small", PROFILES["small"], 0.02)
    curved = Job("car", 0, 0, "small", PROFILES["small"], 0.02, lens=(-0.1, 0.0, 0.0, 0.0, 0.0))
    assert (plain.id, curved.id) == ("car-0-small", "car-0-small-lens")
    assert "lens" not in plain.settings
    assert curved.settings == plain.settings | {"lens": [-0.1, 0.0, 0.0, 0.0, 0.0]}
