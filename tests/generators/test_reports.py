"""The key-frame spacing report and `speed simulate`."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.profiles import PROFILES, Job
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import StaticViews
from spike4dgs.studies import spacing, tradeoff
from spike4dgs.studies.speed import simulate as speed


def drifting(n, px_per_tick, height=12, width=40):
    """Return frames [n + 1, H, W] of a smooth pattern that drifts."""
    x = np.arange(width) - px_per_tick * np.arange(n + 1)[:, None, None]
    y = np.arange(height)[:, None]
    return (0.5 + 0.3 * np.sin(x / 1.5) * np.cos(y / 4)).astype(np.float32)


def test_errors_grow_with_the_spacing_and_the_curve_beats_the_line():
    rows = spacing.compare(drifting(128, 0.05), speed_px_s=1000.0, seconds_per_key=0.5, spacings=[2, 8, 32])
    curves = [r for r in rows if r.interpolation == "Catmull-Rom"]
    lines = [r for r in rows if r.interpolation == "linear"]
    assert [r.motion_px for r in curves] == pytest.approx([0.1, 0.4, 1.6])
    assert [r.render_s_per_ms for r in curves] == pytest.approx([5.0, 1.25, 0.3125])
    for rs in (curves, lines):
        for name in ("tick_error_mean", "integral_error_mean", "counts_off"):
            values = [getattr(r, name) for r in rs]
            assert values == sorted(values)
    assert all(a.tick_error_mean < b.tick_error_mean for a, b in zip(curves, lines, strict=True))
    assert rows[-1].interpolation == "another initial phase"
    assert 20 < rows[-1].counts_off < 50


def test_light_that_changes_linearly_in_time_has_no_error():
    t = np.arange(65)[:, None, None] / 64
    frames = (0.2 + 0.5 * t * np.linspace(0, 1, 30).reshape(5, 6)).astype(np.float32)
    rows = spacing.compare(frames, speed_px_s=1.0, seconds_per_key=1.0, spacings=[2, 64])
    assert max(r.tick_error_p999 for r in rows) < 1e-4
    assert max(r.counts_off for r in rows[:-1]) == 0


def test_report_writes_a_table_and_a_plot(tmp_path, monkeypatch, capsys):
    world = SimpleNamespace(build=lambda *a: None)
    monkeypatch.setattr("spike4dgs.generators.worlds.WORLDS", {"car": world})
    monkeypatch.setattr(spacing, "render_every_tick", lambda *a: (drifting(64, 0.03), 600.0, 0.1))
    assert spacing.spacing("car", out=tmp_path, ticks=64) == 0
    with open(tmp_path / "car.csv") as f:
        rows = list(csv.DictReader(f))
    assert len(rows) == 2 * 6 + 1
    assert float(rows[0]["motion_px"]) == pytest.approx(0.06)
    assert (tmp_path / "car.png").stat().st_size > 20_000
    assert "Catmull-Rom" in capsys.readouterr().out
    for bad in ({"world": "moon"}, {"world": "car", "ticks": 100}):
        with pytest.raises(UserError):
            spacing.spacing(**bad, out=tmp_path)


def test_speed_reports_both_sides_and_the_error(tmp_path, capsys):
    path = tmp_path / "speed.csv"
    arguments = ["--width", "40", "--height", "25", "--ticks", "90", "--repeats", "1", "--csv", str(path)]
    assert speed.simulate(arguments) == 0
    with open(path) as f:
        rows = list(csv.DictReader(f))
    ours = [r for r in rows if "spike4dgs" in r["simulator"]]
    assert rows[0]["simulator"].startswith("numpy") and "spikezoo" in rows[-1]["simulator"]
    assert [r["threads"] for r in ours] == ["1", "2", "2", "2"]
    assert all(float(r["Mpx-ticks/s"]) > 0 and float(r["x numpy"]) > 0 for r in ours)
    assert all(int(r["largest count error"]) <= 1 and float(r["pixels off, %"]) < 1 for r in ours)
    assert "numpy" in capsys.readouterr().out


@pytest.mark.parametrize("ticks", [[0], [22], [399], [111, 276], [200], [17, 18]])
def test_tradeoff_renders_the_keys_that_its_ticks_need_and_no_others(ticks, tmp_path):
    plan, rng = KeyPlan(400, 20_000, 0.5, (20, 4, 2)), np.random.default_rng(0)
    static = StaticViews(np.ones((1, 3, 8, 3), np.float32), np.ones((1, 3, 8, 3), np.float32))
    full, part = KeyStore(tmp_path / "full"), KeyStore(tmp_path / "part")
    keys = tradeoff.needed(plan, ticks)
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


def test_tradeoff_compares_settings_of_a_known_world():
    job = Job("car", 0, 0, "paper", PROFILES["paper"], 0.1)
    listed = list(tradeoff.settings(job).values())
    assert listed[0] == job and len({repr(j) for j in listed}) >= 4
    with pytest.raises(UserError, match="world and --profile"):
        tradeoff.tradeoff("moon")
