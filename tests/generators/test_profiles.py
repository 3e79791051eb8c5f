"""Names and ticks of the scenes to make."""

from __future__ import annotations

from spike4dgs.generators.physics import Physics
from spike4dgs.generators.profiles import PROFILES, Job


def test_names_contain_a_length_that_is_not_the_profiles():
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.5).id == "car-2-paper-500ms"
    assert Job("car", 2, 0, "paper", PROFILES["paper"], 0.1).id == "car-2-paper"
    assert list(Job("car", 0, 0, "small", PROFILES["small"], 0.02).target_ticks) == list(range(20, 400, 20))


def test_a_lens_is_in_the_id_and_the_settings_and_a_pinhole_is_not():
    plain = Job("car", 0, 0, "small", PROFILES["small"], 0.02)
    curved = Job("car", 0, 0, "small", PROFILES["small"], 0.02, physics=Physics(lens=(-0.1, 0.0, 0.0, 0.0, 0.0)))
    assert (plain.id, curved.id) == ("car-0-small", "car-0-small-lens")
    assert "physics" not in plain.settings
    assert curved.settings == plain.settings | {"physics": {"lens": [-0.1, 0.0, 0.0, 0.0, 0.0]}}


def test_seeds_beyond_64_bits_are_text_in_the_settings():
    """Readers of JSON other than Python's keep 64 bits of an integer at most."""
    seeds = (0, 2**63 - 1, 2**63, 2**128 - 1)
    found = [Job("car", 0, seed, "tiny", PROFILES["tiny"], 0.004).settings["seed"] for seed in seeds]
    assert found == [0, 2**63 - 1, str(2**63), str(2**128 - 1)]
