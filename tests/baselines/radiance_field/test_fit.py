"""The fit of a radiance field: a textured plane, resuming, skipping, and times."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from resumed import same_tensors
from toy_fits import silent
from toy_world import ToyWorld

from spike4dgs.baselines.radiance_field import fit
from spike4dgs.baselines.radiance_field.march import camera_rays
from spike4dgs.baselines.radiance_field.model import RadianceModel
from spike4dgs.baselines.radiance_field.occupancy import OccupancySettings
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.method import Budget, FitRequest, Progress
from spike4dgs.method.fit import FitJob
from spike4dgs.method.settings import override, scaled
from spike4dgs.method.splat import Views
from spike4dgs.method.starts.base import Start, measure
from spike4dgs.method.training_views.training_images import TrainingImages

WORLD = ToyWorld(width=40, height=25, n_ticks=80)
TRAVEL = 0.3  # m, of what moves
_SIZES = {"coarse_samples": 24, "fine_samples": 8, "depth": 3, "width": 32, "coarse_depth": 2, "coarse_width": 16}
_RATES = {"position_frequencies": 5, "direction_frequencies": 1, "lr_field": 1e-2, "lr_field_last": 1e-3}
SMALL = fit.RadianceFieldSettings(steps=220, rays=128, **_SIZES, **_RATES)


def plane(camera, t: float = 0.5, travel: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Radiance [H, W] of a textured plane y = 0, and its points [H * W, 3]; the texture moves by `travel` m in all."""
    v, u = np.mgrid[: camera.height, : camera.width].reshape(2, -1) + 0.5
    towards = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1) @ camera.R
    points = camera.center + towards * (-camera.center[1] / towards[:, 1:2])
    x, z = points[:, 0] - travel * (t - 0.5), points[:, 2]
    return (0.5 + 0.3 * np.sin(5 * x + 2 * z) * np.cos(4 * z - 3 * x)).reshape(camera.height, camera.width), points


def job(
    motion=SMALL, progress: Progress = silent, checkpoint: Path | None = None, seed=0, travel=0.0, every=8
) -> FitJob:
    scene = WORLD.training
    ticks = tuple(range(4, 80, 8))
    frames = np.stack([[plane(c, k / 80, travel)[0] for c in scene.cameras] for k in ticks]).astype(np.float32)
    points = np.concatenate([plane(c)[1][::5] for c in scene.cameras])
    points += np.random.default_rng(0).normal(size=points.shape) * [0, 0.02, 0]
    start = Start(scene.cameras, points.astype(np.float32), np.full(len(points), 0.5, np.float32))
    images = TrainingImages(Views.from_cameras(scene.cameras), ticks, torch.from_numpy(frames), 80)
    extent = measure(start, scene)
    grid = OccupancySettings(cells=16, every=every)
    settings = {**fit.RADIANCE_FIELD.settings, "motion": motion, "occupancy": grid}
    request = FitRequest(seed=seed, progress=progress, checkpoint=checkpoint)
    return FitJob(scene, start, images, extent, settings, request, "this")


@cache
def fitted() -> RadianceModel:
    return fit.fit_radiance_field(job(travel=TRAVEL))


@cache
def still() -> RadianceModel:
    return fit.fit_radiance_field(short(travel=0.0))


def psnr(model: RadianceModel, at: float | None = None) -> float:
    """Of the held-out centre camera; `at` stops the model's clock."""
    errors = []
    for t in (0.15, 0.4, 0.85):
        truth = plane(WORLD.held_out, t, TRAVEL)[0]
        errors.append(np.mean((model.render(WORLD.held_out, (at or t) * model.duration_us) - truth) ** 2))
    return float(-10 * np.log10(errors).mean())


def test_what_moves_is_followed_and_seen_from_a_new_viewpoint() -> None:
    model = fitted()
    assert model.field.occupancy.movable.any()
    assert psnr(model) > psnr(model, at=0.5) + 3 and psnr(model) > 26


def test_the_model_knows_the_cameras_that_the_fit_had() -> None:
    assert still().cameras == job(travel=0.0).start.cameras


def test_nothing_moves_where_no_pixel_changes() -> None:
    assert not still().field.occupancy.movable.any()
    images = [still().render(WORLD.held_out, t) for t in (0.0, 3000.0)]
    np.testing.assert_array_equal(*images)
    assert np.isfinite(images[0]).all()


@torch.no_grad()
def test_skipping_what_is_empty_leaves_the_image_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """A striped slab in an empty box: fits as short as the others' hold some fog everywhere, and nothing is skipped."""

    def density(x: torch.Tensor) -> torch.Tensor:
        return 100.0 * (x[:, 1:2].abs() < 0.2)

    field = fit.Fitter(job()).field
    for part in (field.coarse, field.fine):
        monkeypatch.setattr(part, "density_rows", density)
        monkeypatch.setattr(part, "rows", lambda x, view: torch.cat([density(x), 1 + torch.sin(9 * x[:, :1])], 1))
    grid, rays = field.occupancy, camera_rays(WORLD.held_out)
    grid.candidates.fill_(True)
    grid.occupied.fill_(True)
    everything = field.trace(rays, 0.5, None)[1]
    field.update_occupancy(0.5, 1.0, torch.Generator().manual_seed(0))
    assert 0 < int(grid.occupied.sum()) < 0.6 * len(grid.occupied) and everything.std() > 0.1
    torch.testing.assert_close(field.trace(rays, 0.5, None)[1], everything, atol=1e-6, rtol=0)
    grid.occupied.fill_(False)  # what is skipped wrongly is seen
    assert float((field.trace(rays, 0.5, None)[1] - everything).abs().max()) > 0.1


def test_a_render_is_the_same_bits_again_and_stops_at_the_ends_of_the_clip() -> None:
    model = fitted()
    images = {t: model.render(WORLD.held_out, t) for t in (-1e6, 0.0, model.duration_us, 1e9)}
    assert images[0.0].dtype == np.float32 and images[0.0].shape == (25, 40)
    np.testing.assert_array_equal(images[-1e6], images[0.0])
    np.testing.assert_array_equal(images[1e9], images[model.duration_us])
    np.testing.assert_array_equal(model.render(WORLD.held_out, 0.0), images[0.0])
    assert not np.array_equal(images[0.0], images[1e9])


SHORT = replace(SMALL, steps=24, rays=32)


def short(progress: Progress = silent, checkpoint: Path | None = None, seed: int = 0, travel: float = TRAVEL) -> FitJob:
    return job(SHORT, progress, checkpoint, seed, travel, every=3)


def tensors(fitter: fit.Fitter) -> dict[str, torch.Tensor]:
    return {k: v.detach().clone() for k, v in fitter.state().tensors.items()}


@cache
def uninterrupted() -> dict[str, torch.Tensor]:
    fitter = fit.Fitter(short())
    fitter.run()
    return tensors(fitter)


class Killed(Exception):
    pass


@pytest.mark.parametrize("step", [10, 20])
def test_killed_and_resumed_gives_the_same_bits(step: int, tmp_path: Path) -> None:
    def dies(done: int, total: int, note: str = "") -> None:
        if done == step:
            raise Killed

    path = tmp_path / "fit.safetensors"
    with pytest.raises(Killed):
        fit.Fitter(short(dies, path)).run(checkpoint_s=0)
    second = fit.Fitter(short(silent, path))
    second.run()
    same_tensors(tensors(second), uninterrupted())


def test_another_seed_gives_another_field_and_another_fits_checkpoint_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "fit.safetensors"
    other = fit.Fitter(short(silent, path, seed=1))
    other.run()
    assert not torch.equal(tensors(other)["field.fine.value.weight"], uninterrupted()["field.fine.value.weight"])
    with pytest.raises(UserError, match="another fit's; delete it"):
        fit.Fitter(replace(short(silent, path, travel=0.0), key="that")).run()


@pytest.mark.parametrize(("n_ticks", "budget", "steps"), [(400, 1.0, 30), (1000, 1.0, 60), (1000, None, 30)])
def test_steps_follow_the_clip_but_not_a_publications(n_ticks: int, budget: float | None, steps: int) -> None:
    """20 ms and 50 ms."""
    one = job(replace(SHORT, steps=30))
    request = replace(one.request, budget=Budget(budget) if budget else Budget(published=True))
    assert fit.Fitter(replace(one, request=request, extent=replace(one.extent, n_ticks=n_ticks))).total == steps


def test_every_parameter_learns() -> None:
    fitter = fit.Fitter(short())
    before = {k: v.detach().clone() for k, v in fitter.field.named_parameters()}
    for _ in range(3):
        fitter.train_step()
    unchanged = [k for k, v in fitter.field.named_parameters() if torch.equal(v, before[k])]
    assert not unchanged


def test_times_open_up_from_the_middle() -> None:
    fitter = fit.Fitter(job(replace(SHORT, steps=1000)))
    seen: list[set[int]] = []
    for first in (0, 500):
        seen.append(set())
        for step in range(first, first + 60):
            fitter.step = step
            seen[-1].add(fitter.choose_time())
    assert seen[0] <= {3, 4, 5, 6} and seen[1] == set(range(10))


def test_budgets_scale_the_steps_and_published_values_are_settings() -> None:
    s = fit.RADIANCE_FIELD.settings
    motion = fit.RadianceFieldSettings()
    assert scaled(s, 0.5) == {**s, "motion": replace(motion, steps=round(motion.steps / 2))}
    paper = override(s, fit.PUBLISHED, "paper")
    assert isinstance(found := paper["motion"], fit.RadianceFieldSettings)
    assert found.steps == 200_000 and found.width == 256 and found.lr_field == 5e-4
