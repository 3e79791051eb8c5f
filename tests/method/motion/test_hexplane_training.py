from dataclasses import replace

import numpy as np
import pytest
import torch
from gaussian_clouds import cloud
from toy_world import ToyWorld

from spike4dgs.method.gaussians.density import DensitySettings
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.models.fitted_model import FittedModel, MotionSpec
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.hexplane import HexPlaneMotion, HexPlaneSettings, plane_tv, time_smoothness, time_sparsity
from spike4dgs.method.motion.table import Static
from spike4dgs.method.schedule import TrainerSettings
from spike4dgs.method.splat import Views
from spike4dgs.method.supervision.pixel import Pixel
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.trainer import Trainer
from spike4dgs.method.training_views.training_images import TrainingImages

WORLD = ToyWorld(width=32, height=20, side=2)
EXTENT = Extent(-torch.ones(3), torch.ones(3), 3.0, 100, 32)
SETTINGS = TrainerSettings(coarse_steps=3, fine_steps=8, views_per_step=2)
DENSITY = DensitySettings(refine_every=2, refine_stop=0.5)
PLANES = HexPlaneSettings(mlp_width=8, features=4)


def gaussians(n: int = 40) -> Gaussians:
    return replace(cloud(n), extra={})


def trainer(density: DensitySettings = DENSITY, planes: HexPlaneSettings = PLANES) -> Trainer:
    times = (10, 50, 90)
    frames = [[WORLD.trace(c, t / 100)[0] for c in WORLD.cameras] for t in times]
    seen = torch.from_numpy(np.array(frames, np.float32))
    images = TrainingImages(Views.from_cameras(WORLD.cameras), times, seen, n_ticks=100)
    motion = HexPlaneMotion(EXTENT, planes, seeded(0, -1))
    loss = Pixel(Pixel.defaults, WORLD.training)
    return Trainer(images, gaussians(), motion, loss, SETTINGS, density, scale=3.0, seed=0)


def test_regulariser_is_the_weighted_sum_of_its_three_parts() -> None:
    planes = replace(PLANES, tv_weight=2, smooth_weight=3, sparse_weight=5)
    motion = HexPlaneMotion(EXTENT, planes, seeded(0, 0))
    with torch.no_grad():
        for p in motion.planes.time:
            p += 0.3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(2))
    space, time = list(motion.planes.space), list(motion.planes.time)
    expected = 2 * plane_tv(space) + 3 * time_smoothness(time) + 5 * time_sparsity(time)
    assert motion.regularizer().item() == pytest.approx(expected.item(), rel=1e-6)


def test_regulariser_is_trained_beside_the_loss() -> None:
    planes = []
    for weight in (0.0, 100.0):
        t = trainer(planes=replace(PLANES, tv_weight=weight))
        for _ in range(t.total):
            t.train_step()
        assert isinstance(t.motion, HexPlaneMotion)
        planes.append(plane_tv(list(t.motion.planes.space)).item())
    assert planes[1] < 0.9 * planes[0]


def test_learning_rates_fall_over_each_stage_and_follow_the_size_of_the_scene() -> None:
    t, s, seen = trainer(), SETTINGS, []
    for _ in range(t.total):
        t.train_step()
        seen.append({g.name: g.lr for g in t.adam.groups})
    means = [rates["means"] for rates in seen]
    assert means[0] == means[3] == pytest.approx(3.0 * s.lr_means)  # both stages begin at the first rate
    ratio = s.lr_means_last / s.lr_means
    np.testing.assert_allclose(means[3:], 3.0 * s.lr_means * ratio ** (np.arange(8) / 8))
    assert "grid" not in seen[2] and seen[3]["grid"] == pytest.approx(PLANES.lr_grid)
    assert seen[10]["deformation"] < seen[3]["deformation"]


def test_nothing_is_densified_after_its_share_of_a_stage() -> None:
    t, counts = trainer(replace(DENSITY, grow_grad2d=1e-9, max_per_pixel=50)), []
    for _ in range(t.total):
        t.train_step()
        counts.append(len(t.gaussians))
    fine = counts[3:]  # after 2 and 4 of 8 steps, never after 6 and 8
    assert fine[0] < fine[1] == fine[2] < fine[3] and fine[3:] == [fine[3]] * 5


def test_training_changes_what_it_should_at_each_stage() -> None:
    t = trainer()
    before = {k: v.clone() for k, v in t.motion.state_dict().items()}
    for _ in range(3):
        t.train_step()
    assert all(torch.equal(v, before[k]) for k, v in t.motion.state_dict().items())  # the first stage is static
    t.train_step()
    t.train_step()  # the heads start at zero: planes learn from the second step on
    after = t.motion.state_dict()
    assert not torch.equal(after["last.means.weight"], before["last.means.weight"])
    assert not torch.equal(after["planes.time.0"], before["planes.time.0"])


def test_images_are_never_negative() -> None:
    g = gaussians()
    g.colors[:] = -1.0
    static = Static(EXTENT, Static.defaults, seeded(0, 0))
    none, spec = g.rows(torch.zeros(len(g), dtype=torch.bool)), MotionSpec("static", EXTENT, Static.defaults)
    model = FittedModel((g,), none, static, 1000.0, "cpu", spec)
    image = model.render(WORLD.cameras[0], 500.0)
    assert image.dtype == np.float32 and (image == 0).all()
