"""Key-frame spacing, and the keys that the renderer's settings are compared at."""

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import StaticViews
from spike4dgs.studies.speed_error import keys, rendering


def drifting(n, px_per_tick, height=12, width=40):
    """Return frames [n + 1, H, W] of a smooth pattern that drifts."""
    x = np.arange(width) - px_per_tick * np.arange(n + 1)[:, None, None]
    y = np.arange(height)[:, None]
    return (0.5 + 0.3 * np.sin(x / 1.5) * np.cos(y / 4)).astype(np.float32)


def test_errors_grow_with_the_spacing_and_the_curve_beats_the_line():
    found = keys.compare(drifting(128, 0.05), speed_px_s=1000.0, seconds_per_key=0.5, spacings=[2, 8, 32])
    curves, lines = ([p.values for p in series.points] for series in found)
    assert found[0].points[0].role == "exact" and [p.role for p in found[0].points][1:] == ["", "chosen", ""]
    assert [v["px"] for v in curves] == pytest.approx([0.05, 0.1, 0.4, 1.6])
    assert [v["render"] for v in curves] == pytest.approx([10.0, 5.0, 1.25, 0.3125])
    for values in (curves, lines):
        for name in ("tick", "integral", "counts"):
            each = [v[name] for v in values]
            assert each == sorted(each) and each[0] == 0
    assert all(a["tick"] < b["tick"] for a, b in zip(curves[1:], lines[1:], strict=True))


def test_light_that_changes_linearly_in_time_has_no_error():
    t = np.arange(65)[:, None, None] / 64
    frames = (0.2 + 0.5 * t * np.linspace(0, 1, 30).reshape(5, 6)).astype(np.float32)
    curves = keys.compare(frames, speed_px_s=1.0, seconds_per_key=1.0, spacings=[2, 64])
    values = [p.values for series in curves for p in series.points]
    assert max(v["worst"] for v in values) < 1e-4 and max(v["counts"] for v in values) == 0


@pytest.mark.parametrize("ticks", [[0], [22], [399], [111, 276], [200], [17, 18]])
def test_the_keys_that_ticks_need_are_rendered_and_no_others(ticks, tmp_path):
    plan, rng = KeyPlan(400, 20_000, 0.5, (20, 4, 2)), np.random.default_rng(0)
    static = StaticViews(np.ones((1, 3, 8, 3), np.float32), np.ones((1, 3, 8, 3), np.float32))
    full, part = KeyStore(tmp_path / "full"), KeyStore(tmp_path / "part")
    keys = rendering.needed(plan, ticks)
    assert {plan.level(t) for t in keys} == {0, 1, 2}, "the time of each spacing is measured"
    for store in (full, part):
        store.folder.mkdir()
        store.set_static(static)
    for tick in plan.ticks:
        mask = rng.random((3, 8)) < (1.0 if plan.level(tick) == 0 else 0.4)
        arrays = {"given0": np.packbits(mask), "values0": rng.random(int(mask.sum())).astype(np.float32)}
        full.put(tick, arrays)
        if tick in keys:
            part.put(tick, arrays)
    for tick in ticks:
        np.testing.assert_array_equal(part.radiance(0, plan, tick), full.radiance(0, plan, tick))
    needless = 0
    for key in keys:
        path = part.folder / f"{key:06d}.npz"
        path.rename(tmp_path / "aside")
        try:
            [part.radiance(0, plan, tick) for tick in ticks]
            needless += 1
        except UserError:
            pass
        (tmp_path / "aside").rename(path)
    assert needless <= 2, "but one of each spacing"


def test_the_settings_that_are_compared_differ_and_the_profile_is_the_first():
    job = Job("car", 0, 0, "paper", PROFILES["paper"], 0.1)
    listed = list(rendering.settings(job).values())
    assert listed[0] == job and len({repr(j) for j in listed}) == len(listed)
