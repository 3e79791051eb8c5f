from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from resumed import same_tensors
from scipy.spatial.transform import Rotation, Slerp
from toy_fits import silent
from toy_world import ToyWorld

from spike4dgs.baselines.images.tfi import tfi_image
from spike4dgs.baselines.tracking import fit
from spike4dgs.baselines.tracking.losses import find_neighbours
from spike4dgs.baselines.tracking.model import TrackedModel, Tracks
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import FitRequest
from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.fit import FitJob
from spike4dgs.method.gaussians.parameters import Gaussians, from_points
from spike4dgs.method.images.light import Light
from spike4dgs.method.images.training import ImageSettings
from spike4dgs.method.settings import override
from spike4dgs.method.splat import Views
from spike4dgs.method.starts.base import Start, measure
from spike4dgs.method.supervision.pixel import PixelSettings
from spike4dgs.method.training_views.foreground import foreground_masks
from spike4dgs.method.training_views.light_layers import factor_at
from spike4dgs.method.training_views.training_images import TrainingImages

WORLD = ToyWorld(width=64, height=40, n_ticks=240, travel=0.25)
CAMERAS = tuple(c for c in WORLD.cameras if c is not WORLD.held_out)
TIMES = 5
TINY = {"first_steps": 3, "later_steps": 2, "first_move": 1.0, "views_per_step": 2, "neighbours": 4}


@cache
def shown() -> tuple[TrainingImages, Start]:
    """Exact images of the board at `TIMES` times, and noisy points on the surfaces as they are at the middle one."""
    ticks = tuple(int(t) for t in np.linspace(0, WORLD.n_ticks, TIMES))
    frames = np.array([[WORLD.trace(c, t / WORLD.n_ticks)[0] for c in CAMERAS] for t in ticks], np.float32)
    start = Start(CAMERAS, *WORLD.surfaces(CAMERAS[::3], 0.005))
    return TrainingImages(Views.from_cameras(CAMERAS), ticks, torch.from_numpy(frames), WORLD.n_ticks), start


def job(
    checkpoint: Path | None = None,
    progress: Callable[..., None] = silent,
    static: bool = False,
    ssim_weight: float = 0.2,
    **changes: object,
) -> FitJob:
    images, start = shown()
    if static:
        images = replace(images, images=images.images[2:3].expand(TIMES, -1, -1, -1).contiguous())
    scene = TrainingScene("toy", "toy", CAMERAS, (), 20000.0, WORLD.n_ticks, 0.6)
    motion, supervision = replace(fit.TrackingSettings(), **changes), PixelSettings(ssim_weight)
    settings = {**fit.TRACKING.settings, "motion": motion, "supervision": supervision}
    request = FitRequest(progress=progress, checkpoint=checkpoint)
    return FitJob(scene, start, images, measure(start, scene), settings, request, "this")


def test_times_are_visited_outward_with_the_velocity_known_so_far() -> None:
    assert fit.visits(2, 5) == [fit.Visit(3, 2, None), fit.Visit(4, 3, 2), fit.Visit(1, 2, 3), fit.Visit(0, 1, 2)]
    assert fit.visits(0, 3) == [fit.Visit(1, 0, None), fit.Visit(2, 1, 0)]
    assert fit.visits(2, 3) == [fit.Visit(1, 2, None), fit.Visit(0, 1, 2)]
    assert fit.visits(0, 1) == []
    known = {7}
    for v in fit.visits(7, 20):
        assert {v.before, *([] if v.earlier is None else [v.earlier])} <= known
        known.add(v.index)
    assert known == set(range(20))


def test_noise_of_images_does_not_pass_for_motion() -> None:
    """Still light with TFI's noise, which grows with the square of the light; and of a sensor that fired nothing."""
    height, width = CAMERAS[0].height, CAMERAS[0].width
    rate = np.broadcast_to(np.linspace(0.03, 0.55, width), (height, width))
    phase = np.random.default_rng(0).random((len(CAMERAS), height, width))
    fired = [np.diff(np.floor(p + rate * np.arange(WORLD.n_ticks + 1)[:, None, None]), axis=0) for p in phase]
    streams = tuple(SpikeStream(pack(f), width, height, 20_000.0) for f in fired)
    ticks = tuple(range(16, WORLD.n_ticks - 16, 16))
    images = torch.tensor(np.array([[tfi_image(s, t) for s in streams] for t in ticks]) / np.float32(0.6))
    one = job()
    seen = replace(one.training_images, images=images.float(), ticks=ticks)
    one = replace(one, training_images=seen, settings={**one.settings, "images": ImageSettings(16)})
    scene = TrainingScene("toy", "toy", CAMERAS, streams, 20_000.0, WORLD.n_ticks, 0.6)
    assert fit.silhouettes(replace(one, scene=scene)).float().mean() < 0.01
    assert fit.silhouettes(one).float().mean() > 0.3


@pytest.mark.parametrize(("start", "index"), [(0.0, 0), (0.5, 2), (1.0, 4), (-3.0, 0), (9.0, 4)])
def test_the_first_time_is_where_the_settings_say(start: float, index: int) -> None:
    assert fit.first_index(job(start=start)) == index


@pytest.mark.parametrize(("lacking", "index"), [({2: 8}, 1), ({2: 3, 1: 4}, 3), ({i: 8 for i in range(TIMES)}, 2)])
def test_the_first_time_is_one_that_most_views_have_measured(lacking: dict[int, int], index: int) -> None:
    j = job()
    missing = torch.zeros(TIMES, len(CAMERAS), dtype=torch.bool)
    for time, views in lacking.items():
        missing[time, :views] = True
    assert fit.first_index(replace(j, training_images=replace(j.training_images, missing=missing))) == index


@cache
def tracked() -> TrackedModel:
    return fit.fit_tracking(job(first_steps=100, lr_means=3e-3, lr_means_last=1e-4, lr_colors=2.5e-4))


def test_known_translation_is_recovered() -> None:
    model = tracked()
    tracks, g = model.tracks, model.gaussians
    # The Gaussians on the board, told by its true position at the first time.
    x, y, z = g.means[tracks.free].unbind(-1)
    board = (x.abs() < 0.4) & (y.abs() < 0.05) & ((z - 0.6).abs() < 0.3) & (g.logits[tracks.free].sigmoid() > 0.3)
    assert board.sum() > 50
    moved = (tracks.means[:, board] - tracks.means[2, board]).median(dim=1).values  # [T, 3]
    expected = WORLD.travel * (torch.linspace(0, 1, TIMES) - 0.5)
    torch.testing.assert_close(moved[:, 0], expected, atol=0.025 * WORLD.travel, rtol=0)
    assert moved[:, 2].abs().max() < 0.025 * WORLD.travel
    assert moved[:, 1].abs().max() < 0.03  # depth: a fifth of a pixel of parallax across the whole array


def test_the_board_is_seen_from_a_new_viewpoint_at_times_between_the_tracked_ones() -> None:
    for t in (0.375, 0.625, 0.8):
        truth, _, board = WORLD.trace(WORLD.held_out, t)
        error = (tracked().render(WORLD.held_out, t * WORLD.n_ticks * 50.0) - truth) ** 2
        assert -10 * np.log10(error[board].mean()) > 22


def test_the_background_is_fixed_or_hardly_moves() -> None:
    model = tracked()
    start, stop = model.at(0.0), model.at(model.duration_us)
    others = torch.ones(len(start), dtype=torch.bool).index_fill(0, model.tracks.free, False)
    assert torch.equal(start.means[others], stop.means[others])
    assert torch.equal(start.quats[others], stop.quats[others])
    assert not torch.equal(start.means, stop.means)
    soft = fit.fit_tracking(job(**TINY, freeze_background=False))
    moving = int(fit.fit_tracking(job(**TINY)).tracks.free.numel())
    assert len(soft.tracks.free) == len(soft.tracks.rows) > moving
    assert (soft.tracks.means[0, moving:] != soft.tracks.means[2, moving:]).any()


def tracker_of(j: FitJob) -> fit.Tracker:
    g = from_points(j.start.points, j.start.values, opacity=0.5)
    tracker = fit.Tracker(j, g, foreground_masks(j.training_images.images))
    tracker.graph = find_neighbours(tracker.local.means[: tracker.count], 4)
    return tracker


def test_only_the_window_is_rendered_and_the_gradient_is_that_of_the_whole_image() -> None:
    gradients = []
    for margin in (8, 1000):
        j = job(**TINY, margin_px=margin, ssim_weight=0.0)
        tracker = tracker_of(j)
        old = tracker.tracks.at(2)
        leaves = {k: v.clone().requires_grad_() for k, v in old.items()}
        tracker.loss(3, old)(leaves, [0, 3, 5]).backward()
        gradients.append([leaves[k].grad[: tracker.count] for k in ("means", "quats", "colors")])
    assert tracker_of(job(**TINY)).share < 0.8
    for a, b in zip(*gradients, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-3 * float(b.abs().max()))


def test_what_flies_off_to_where_nothing_moves_stays_where_it_was() -> None:
    tracker = tracker_of(job(**TINY))
    tracks = tracker.tracks
    tracks.means[1, 7] -= torch.tensor([0.0, 0.0, 0.45])  # from there its velocity takes it far above the board
    tracker.track(fit.Visit(3, 2, 1))
    assert torch.equal(tracks.means[3, 7], tracks.means[2, 7])
    assert (tracks.means[3, 8:] != tracks.means[2, 8:]).any(dim=1).float().mean() > 0.9


class Killed(Exception):
    pass


@cache
def uninterrupted() -> TrackedModel:
    return fit.fit_tracking(job(**TINY))


def everything(model: TrackedModel) -> dict[str, torch.Tensor]:
    return {**model.gaussians.tensors(), **{f"tracks.{k}": v for k, v in model.tracks.tensors().items()}}


@pytest.mark.parametrize("time", ["loss", "time 2", "time 3", "time 4", "time 5"])
def test_killed_at_any_time_and_resumed_gives_the_same_bits(time: str, tmp_path: Path) -> None:
    path = tmp_path / "fit.safetensors"

    def dies(done: int, total: int, note: str = "") -> None:
        if note.startswith(time):
            raise Killed

    with pytest.raises(Killed):
        fit.fit_tracking(job(path, dies, **TINY), checkpoint_s=0)
    assert path.is_file() == (time != "loss")  # before the end of the first time there is nothing to go on from
    seen: list[str] = []
    resumed = fit.fit_tracking(job(path, lambda done, total, note="": seen.append(note), **TINY))
    assert any(note.startswith("loss") for note in seen) == (time == "loss")
    same_tensors(everything(resumed), everything(uninterrupted()))


def test_finished_fit_is_read_back_and_another_fit_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.safetensors"
    one, two = (fit.fit_tracking(job(path, **TINY)) for _ in range(2))
    images = [m.render(WORLD.held_out, 3000.0) for m in (one, two)]
    assert images[0].dtype == np.float32 and images[0].shape == (40, 64) and np.array_equal(*images)
    with pytest.raises(UserError, match="another fit's; delete it"):
        fit.fit_tracking(replace(job(path, **TINY), key="that"))


def test_the_model_knows_the_cameras_that_the_fit_had() -> None:
    """What `fit` shows the images of: where poses were estimated, others than the scene's."""
    assert uninterrupted().cameras == shown()[1].cameras


def test_progress_counts_all_steps_to_the_end() -> None:
    seen: list[tuple[int, int]] = []
    fit.fit_tracking(job(progress=lambda done, total, note="": seen.append((done, total)), **TINY))
    assert {total for _, total in seen} == {3 + 4 * 2}
    assert [done for done, _ in seen] == sorted(done for done, _ in seen) and seen[-1][0] == 11


@pytest.mark.parametrize("few", [{"first_move": 0.1}, {"later_steps": 0}])
def test_a_time_takes_a_step_at_least(few: dict[str, float]) -> None:
    tracker, visit = tracker_of(job(**{**TINY, **few})), fit.Visit(3, 2, None)
    assert fit.step_count(tracker.settings, visit) == 1 and np.isfinite(tracker.track(visit))


def test_tracking_without_neighbours_is_refused() -> None:
    with pytest.raises(UserError, match=r"neighbours: expected at least 1, found 0"):
        fit.TrackingSettings(neighbours=0)


def test_a_scene_in_which_nothing_moves_is_one_image(tmp_path: Path) -> None:
    model = fit.fit_tracking(job(tmp_path / "fit.safetensors", static=True, **TINY))
    images = [model.render(WORLD.held_out, t) for t in (0.0, 6000.0, 12000.0)]
    assert len(model.tracks.free) == 0 and np.array_equal(images[0], images[1]) and np.array_equal(images[1], images[2])


@pytest.mark.parametrize("static", [False, True])
def test_a_fit_in_mean_light_renders_the_light_of_its_instant(static: bool) -> None:
    """Of the background too, which nothing tracks."""
    j = job(**TINY, static=static)
    light = Light(1 + 0.3 * np.sin(2 * np.pi * np.arange(WORLD.n_ticks) / WORLD.n_ticks))
    mean, lit = fit.fit_tracking(j), fit.fit_tracking(replace(j, light=light))
    times_us = mean.tracks.times_us
    for t_us in (*times_us.tolist(), *((times_us[1:] + times_us[:-1]) / 2).tolist()):
        image = mean.render(WORLD.held_out, t_us) * factor_at(light.factors, t_us / mean.duration_us)
        np.testing.assert_allclose(lit.render(WORLD.held_out, t_us), image, atol=1e-5)


def six() -> Gaussians:
    points = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    return from_points(points, np.ones(6, np.float32), opacity=0.5)


def tracks() -> Tracks:
    """Three times of four Gaussians that move along and turn about the y axis by 4 and then 2 degrees."""
    made = Tracks.start(six(), torch.tensor([1, 4, 2, 5]), torch.tensor([5, 1, 4, 2, 0]), (10, 30, 40), 20000.0)
    for i, (x, angle) in enumerate([(0.0, 0.0), (1.0, 4.0), (3.0, 6.0)]):
        half = np.deg2rad(angle) / 2
        quat = torch.tensor([np.cos(half), 0, np.sin(half), 0], dtype=torch.float32)
        colors = torch.full((5, 1), 0.2 * i)
        made.put(i, {"means": torch.full((4, 3), x), "quats": 3 * quat.expand(4, 4), "colors": colors})
    return made


@pytest.mark.parametrize(
    ("t_us", "x", "color"),
    [(500, 0, 0), (1000, 0.5, 0.1), (1500, 1, 0.2), (1875, 2.5, 0.35), (2000, 3, 0.4), (250, -0.25, 0), (2250, 4, 0.4)],
)
def test_between_times_all_is_linear_and_positions_go_on_beyond_the_ends(t_us: float, x: float, color: float) -> None:
    values = tracks().between(t_us)
    torch.testing.assert_close(values["means"], torch.full((4, 3), float(x)))
    torch.testing.assert_close(values["colors"], torch.full((5, 1), float(color)))


def test_rotations_between_times_are_those_of_slerp() -> None:
    slerp = Slerp([500, 1500, 2000], Rotation.from_rotvec(np.deg2rad([[0, 0, 0], [0, 4, 0], [0, 6, 0]])))
    for t_us in np.linspace(500, 2000, 13):
        w, x, y, z = tracks().between(float(t_us))["quats"][0].tolist()
        error = (Rotation.from_quat([x, y, z, w]) * slerp(t_us).inv()).magnitude()
        assert np.rad2deg(error) < 0.001


def test_model_moves_only_its_own_gaussians_and_holds_the_clips_ends() -> None:
    g = six()
    model = TrackedModel(g, tracks(), duration_us=2500.0)
    now = model.at(1500.0)
    assert torch.equal(now.means[[0, 3]], g.means[[0, 3]]) and (now.means[[1, 2, 4, 5]] == 1).all()
    assert torch.equal(now.colors[3], g.colors[3])
    assert torch.equal(model.at(9999.0).means, model.at(2500.0).means)
    assert torch.equal(model.at(-5.0).means, model.at(0.0).means)
    assert model.size_bytes == 4 * (6 * 12 + 3 * (4 * 7 + 5))


def test_budget_scales_steps_only_and_the_publications_counts_are_settings() -> None:
    s = fit.TrackingSettings()
    half = s.scaled(0.5)
    assert (half.first_steps, half.later_steps) == (s.first_steps // 2, s.later_steps // 2)
    assert replace(half, first_steps=s.first_steps, later_steps=s.later_steps) == s
    paper = override(fit.TRACKING.settings, fit.PUBLISHED, "paper")
    assert fit.TRACKING.published == fit.PUBLISHED and paper["motion"] == replace(s, first_steps=2500, later_steps=500)
