"""The clocks of an array from a clip, and their normal equations."""

from dataclasses import replace

import numpy as np
import pytest
from clock_world import ClockWorld
from hard_case import REFUSAL, HardCase
from toy_world import few_views

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.camera_state import Clock
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.self_calibration.clock_fit import ClockSettings
from spike4dgs.method.self_calibration.clock_search import SearchSettings, best_offsets
from spike4dgs.method.self_calibration.clocks import ArrayClocks, clock_of_another, estimate_clocks
from spike4dgs.method.self_calibration.normal_equations import Prior, reduce
from spike4dgs.method.training_views.warm_up_scene import warm_up_scene


@pytest.mark.parametrize("seed", range(3))
def test_eliminated_unknowns_change_nothing(seed: int) -> None:
    P, K, C, Q, M = 4, 3, 5, 2, 3
    rng = np.random.default_rng(seed)
    value, h = rng.normal(size=(P, K, C)), rng.normal(size=(P, K, C, M))
    a, weight = rng.normal(size=(P, K, C, Q)), rng.random((P, K, C)) * (rng.random((P, K, C)) < 0.9)
    prior, now = np.array([0.3, 0.1, 0.2]), rng.normal(size=(P, M))
    found = reduce(value, h, a, weight, Prior(prior, prior * now))
    numbers, surfaces = np.linalg.solve(found.H + np.eye(C * Q), -found.g), None
    surfaces = found.surface_steps(numbers)

    rows, right = [], []
    for p, k, c in np.ndindex(P, K, C):
        row = np.zeros(C * Q + P * M + P * K)
        row[c * Q : (c + 1) * Q] = a[p, k, c]
        row[C * Q + p * M : C * Q + (p + 1) * M] = h[p, k, c]
        row[C * Q + P * M + p * K + k] = -1
        rows.append(np.sqrt(weight[p, k, c]) * row)
        right.append(-np.sqrt(weight[p, k, c]) * value[p, k, c])
    for p, m in np.ndindex(P, M):
        row = np.zeros(C * Q + P * M + P * K)
        row[C * Q + p * M + m] = np.sqrt(prior[m])
        rows.append(row)
        right.append(-np.sqrt(prior[m]) * now[p, m])
    for q in range(C * Q):
        rows.append(np.eye(C * Q + P * M + P * K)[q])
        right.append(0.0)
    dense = np.linalg.lstsq(np.array(rows), np.array(right), rcond=None)[0]
    np.testing.assert_allclose(numbers, dense[: C * Q], atol=1e-9)
    np.testing.assert_allclose(surfaces.ravel(), dense[C * Q : C * Q + P * M], atol=1e-9)


def test_no_patch_tells_nothing() -> None:
    """An array that sees nothing has no patches: the equations are zeros of the usual shapes."""
    C, Q, M = 5, 2, 3
    empty = np.zeros((0, 3, C))
    found = reduce(empty, np.zeros((0, 3, C, M)), np.zeros((0, 3, C, Q)), empty, Prior(np.ones(M), np.zeros((0, M))))
    np.testing.assert_array_equal(found.H, np.zeros((C * Q, C * Q)))
    np.testing.assert_array_equal(found.g, np.zeros(C * Q))
    assert found.surface_steps(np.zeros(C * Q)).shape == (0, M)


FEW = ClockSettings(times=5, moving_patches=25, static_patches=8, prior_drift_ppm=1e4)
SHORT = SearchSettings(times=3, most_ticks=100, patches=10, depths=6)
TICKS = {"cam_00": 3.3, "cam_01": -2.0, "cam_02": 7.75, "cam_03": -30.0, "cam_05": 0.0, "cam_06": 12.5, "cam_07": 55.0}


def errors(world: ClockWorld, found: ArrayClocks) -> np.ndarray:
    """Differences of offsets at the middle of the clip, of cameras that are right on average."""
    middle = world.n_ticks / 2
    true = np.array([world.clocks.get(c.id, Clock()).local(middle) - middle for c in world.training.cameras])
    told = np.array([found.cameras[c.id].middle_ticks for c in world.training.cameras])
    return (told - told.mean()) - (true - true.mean())


def test_offsets_come_out_to_a_quarter_of_a_tick_and_a_drift_too() -> None:
    ppm = 8000.0  # 2 ticks in 240
    clocks = {camera: Clock(ticks) for camera, ticks in TICKS.items()} | {"cam_08": Clock(-ppm * 1e-6 * 120, ppm)}
    world = ClockWorld(clocks=clocks)
    found = estimate_clocks(world.training, FEW, SHORT)
    assert np.abs(errors(world, found)).max() < 0.25
    assert found.px_per_tick > 0.05 and all(e.error_ticks < 0.5 for e in found.cameras.values())
    assert abs(np.mean([e.middle_ticks for e in found.cameras.values()])) < 1e-6
    drifts = {camera: e.clock.drift_ppm for camera, e in found.cameras.items()}
    others = [drift for camera, drift in drifts.items() if camera != "cam_08"]
    assert drifts["cam_08"] - np.mean(others) == pytest.approx(ppm, rel=0.25)


def test_where_nothing_moves_the_standard_errors_say_so() -> None:
    still = ClockWorld(n_ticks=130, clocks={"cam_02": Clock(9.0)}, travel=0.0, views=(0, 2, 5, 7)).training
    found = estimate_clocks(still, replace(FEW, times=3, moving_patches=10), replace(SHORT, times=2, most_ticks=20))
    assert min(e.error_ticks for e in found.cameras.values()) > 2


def test_the_clock_of_a_held_out_camera_is_on_the_clock_of_the_others() -> None:
    world = ClockWorld(clocks={"cam_04": Clock(9.5)}, views=(1, 3, 4, 6))
    found = clock_of_another(world.training, world.held_out, world.stream(world.held_out, 4), s=FEW, search=SHORT)
    assert found.middle_ticks == pytest.approx(9.5, abs=0.3)


@pytest.mark.hard_case(asked="clocks from two cameras, and from clips of 40 and 60 ticks", **REFUSAL)
def test_too_little_data_are_refused(hard_case: HardCase) -> None:
    with pytest.raises(UserError, match="clocks of toy: expected 3 cameras"):
        estimate_clocks(ClockWorld(n_ticks=60).training)
    usual = warm_up_scene()[0]
    two = few_views(usual, 0, 1)
    short = filled_with(hard_case.rng().random((40, usual.streams[0].height, usual.streams[0].width)) < 0.5)
    hard_case.refused({"two cameras": lambda: estimate_clocks(two), "40 ticks": lambda: estimate_clocks(short)})


def filled_with(spikes: np.ndarray) -> TrainingScene:
    """Return the warm-up scene with these spikes [T, H, W] for every camera."""
    usual = warm_up_scene()[0]
    stream = SpikeStream(pack(spikes.astype(np.uint8)), spikes.shape[2], spikes.shape[1], 20_000.0)
    return replace(usual, streams=(stream,) * len(usual.streams), n_ticks=len(spikes))


@pytest.mark.hard_case(
    asked="clocks of an array whose pixels fire {level} times a tick",
    twin="standard errors above 2 ticks: nothing is known", unit="cameras too sure",
)  # fmt: skip
@pytest.mark.parametrize("level", [0, 1])
def test_an_array_that_sees_nothing_knows_no_clock(level: int, hard_case: HardCase) -> None:
    first = warm_up_scene()[0].streams[0]
    found = estimate_clocks(filled_with(np.full((240, first.height, first.width), level))).cameras.values()
    errors = [e.error_ticks for e in found]
    sure = sum(not (e.error_ticks > 2 and np.isfinite(e.clock.offset_ticks)) for e in found)
    hard_case.check(sure, f"standard errors from {min(errors):.3g} ticks", bool(np.isfinite(errors).all()))


def test_the_best_offsets_of_all_pairs_are_found() -> None:
    rng, true = np.random.default_rng(0), np.array([0, 3, -5, 8, 1])
    apart = true[None] - true[:, None]
    offsets = np.arange(-20, 21)
    costs = 1 - np.exp(-0.5 * (offsets - apart[..., None]) ** 2) + 0.1 * rng.random((5, 5, 41))
    costs[0, 3] = costs[3, 0] = 1 - np.exp(-0.5 * (offsets + 4) ** 2)  # one pair is wrong
    assert (best_offsets(costs) == true).all()
