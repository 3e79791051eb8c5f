from dataclasses import replace

import numpy as np
import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.method.fitted_model import FittedModel, MotionSpec
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.motion.hexplane import plane_tv, time_smoothness, time_sparsity
from spike4dgs.method.motion.table import MOTIONS, Extent, HexPlane4DGS
from spike4dgs.method.observations.training_images import TrainingImages
from spike4dgs.method.settings import TrainSettings
from spike4dgs.method.splat import Views
from spike4dgs.method.supervision.table import SUPERVISIONS
from spike4dgs.method.trainer import Trainer, seeded

WORLD = ToyWorld(width=32, height=20, side=2)
EXTENT = Extent(-torch.ones(3), torch.ones(3), 3.0, 100, 32)
SETTINGS = TrainSettings(
    coarse_steps=3, fine_steps=8, refine_every=2, refine_until=0.5, mlp_width=8, features=4, views_per_step=2
)


def gaussians(n: int = 40) -> Gaussians:
    rng = torch.Generator().manual_seed(1)
    return Gaussians(
        means=torch.rand(n, 3, generator=rng),
        log_scales=torch.full((n, 3), -2.5),
        quats=torch.randn(n, 4, generator=rng),
        logits=torch.zeros(n),
        colors=torch.rand(n, 1, generator=rng),
    )


def trainer(settings: TrainSettings) -> Trainer:
    times = (10, 50, 90)
    looks = [[WORLD.look(c, t / 100)[0] for c in WORLD.cameras] for t in times]
    footage = TrainingImages(
        Views.from_cameras(WORLD.cameras), times, torch.from_numpy(np.array(looks, np.float32)), n_ticks=100
    )
    motion = MOTIONS["hexplane"](EXTENT, settings, seeded(0, -1))
    loss = SUPERVISIONS["pixel"](settings, WORLD.training)
    return Trainer(footage, gaussians(), motion, loss, settings, scale=3.0, seed=0)


def test_regulariser_is_the_weighted_sum_of_its_three_parts() -> None:
    motion = MOTIONS["hexplane"](EXTENT, replace(SETTINGS, tv_weight=2, smooth_weight=3, sparse_weight=5), seeded(0, 0))
    assert isinstance(motion, HexPlane4DGS)
    with torch.no_grad():
        for p in motion.planes.time:
            p += 0.3 * torch.randn(p.shape, generator=torch.Generator().manual_seed(2))
    space, time = list(motion.planes.space), list(motion.planes.time)
    expected = 2 * plane_tv(space) + 3 * time_smoothness(time) + 5 * time_sparsity(time)
    assert motion.regularizer().item() == pytest.approx(expected.item(), rel=1e-6)


def test_regulariser_is_trained_beside_the_loss() -> None:
    planes = []
    for weight in (0.0, 100.0):
        t = trainer(replace(SETTINGS, tv_weight=weight))
        for _ in range(t.total):
            t.train_step()
        assert isinstance(t.motion, HexPlane4DGS)
        planes.append(plane_tv(list(t.motion.planes.space)).item())
    assert planes[1] < 0.9 * planes[0]


def test_rates_fall_over_each_stage_and_follow_the_size_of_the_scene() -> None:
    t, s, seen = trainer(SETTINGS), SETTINGS, []
    for _ in range(t.total):
        t.train_step()
        seen.append({g["name"]: g["lr"] for g in t.adam.param_groups})
    means = [rates["means"] for rates in seen]
    assert means[0] == means[3] == pytest.approx(3.0 * s.means_rate)  # both stages begin at the first rate
    ratio = s.means_rate_last / s.means_rate
    np.testing.assert_allclose(means[3:], 3.0 * s.means_rate * ratio ** (np.arange(8) / 8))
    assert "grid" not in seen[2] and seen[3]["grid"] == pytest.approx(s.grid_rate)
    assert seen[10]["deformation"] < seen[3]["deformation"]


def test_nothing_is_refined_after_its_share_of_a_stage() -> None:
    t, counts = trainer(replace(SETTINGS, grow_gradient=1e-9, max_per_pixel=50)), []
    for _ in range(t.total):
        t.train_step()
        counts.append(len(t.gaussians))
    fine = counts[3:]  # after 2 and 4 of 8 steps, never after 6 and 8
    assert fine[0] < fine[1] == fine[2] < fine[3] and fine[3:] == [fine[3]] * 5


def test_training_changes_what_it_should_at_each_stage() -> None:
    t = trainer(SETTINGS)
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
    static = MOTIONS["static"](EXTENT, SETTINGS, seeded(0, 0))
    model = FittedModel(
        (g,),
        g.rows(torch.zeros(len(g), dtype=torch.bool)),
        static,
        1000.0,
        "cpu",
        MotionSpec("static", EXTENT, SETTINGS),
    )
    image = model.render(WORLD.cameras[0], 500.0)
    assert image.dtype == np.float32 and (image == 0).all()
