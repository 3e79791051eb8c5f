"""Every path on a CUDA device: the checklist for a new machine. Skipped where there is none.

The rasteriser is compared with the float64 reference; a path, with the same fit on the CPU.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import saved_models
import splat_parity
import torch
from splat_scenes import HARD, far_origin, random_splats, views
from toy_bursts import write_toy_shard
from toy_world import ToyWorld

from spike4dgs.benchmark import environment
from spike4dgs.benchmark.environment import missing_rasterizer
from spike4dgs.benchmark.method import Budget, FitRequest, find_methods
from spike4dgs.benchmark.scene.training_bursts import open_folder
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.msdi import TINY
from spike4dgs.method.msdi.train import Training, TrainingSettings
from spike4dgs.method.msdi.training_data import Bursts
from spike4dgs.method.splat import Splats, Views, render
from spike4dgs.method.splat.background import Background
from spike4dgs.method.splat.ssim import ssim, ssim_reference

METHODS = find_methods()


def _why_not() -> str:
    if not torch.cuda.is_available():
        return "no CUDA device"
    missing = missing_rasterizer()
    return f"rendering on CUDA needs {missing.expected}, found {missing.found}: {missing.fix}" if missing else ""


WHY_NOT = _why_not()
pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT)


def on_device(splats: Splats) -> list[torch.Tensor]:
    return [t.detach().to("cuda").requires_grad_() for t in splats.tensors]


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("scene", HARD)
def test_hard_scenes(scene: Callable[[], tuple[Splats, Views]], dtype: torch.dtype) -> None:
    splats, v = scene()
    if scene is far_origin and dtype == torch.float32:
        pytest.skip("float32 resolves 1 mm at 1e4 m: promised for float64 inputs only")
    cast = Splats(*(t.to(dtype) for t in splats.tensors))
    splat_parity.compare(cast, v, "cuda", "cuda")


@pytest.mark.parametrize("scene", HARD)
def test_hard_scenes_antialiased_with_depth(scene: Callable[[], tuple[Splats, Views]]) -> None:
    splat_parity.compare(*scene(), "cuda", "cuda", depth=True, antialiased=True)


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 9])
def test_any_number_of_channels(channels: int) -> None:
    splat_parity.compare(random_splats(120, channels, seed=20), views(), "cuda", "cuda", depth=True)


def test_the_trial_passes_where_nothing_is_differentiated() -> None:
    environment.trial.cache_clear()  # as in a process whose first render is one of a saved model
    with torch.no_grad():
        assert not environment.trial()


def test_equal_inputs_give_equal_bits() -> None:
    splats, v = random_splats(3000, seed=23), views()
    keep = torch.ones(2, v.height, v.width)
    results = []
    for _ in range(3):
        out, grads = splat_parity.differentiate(splats, v, "cuda", keep, True, "cuda")
        results.append([out.image, out.alpha, out.depth, out.radii, *grads.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_a_background_gives_what_all_at_once_gives() -> None:
    splats, v = random_splats(300, 2, seed=5), views(3)
    few = Views(v.w2c[[2, 0]], v.K[[2, 0]], v.width, v.height)
    everything, own = on_device(splats), [t[280:].detach().requires_grad_() for t in on_device(splats)]
    expected = render(Splats(*everything), few)
    behind = Splats(*(t[:280].detach() for t in everything))
    background = Background(behind, v)
    found = background.render(Splats(*own), [2, 0])
    assert torch.equal(found.image, expected.image) and torch.equal(found.alpha, expected.alpha)
    for out in (expected, found):
        out.image.square().sum().backward()
    for a, b in zip(everything, own, strict=True):
        assert torch.equal(a.grad[280:], b.grad)
    assert torch.equal(expected.means2d.grad[:, 280:], found.means2d.grad)


def test_ssim_keeps_float32() -> None:
    g = torch.Generator().manual_seed(0)
    a = torch.rand(3, 125, 200, generator=g)
    b = (a + 0.02 * torch.randn(a.shape, generator=g)).clamp(0, 1)
    fast, slow = a.cuda().requires_grad_(), a.double().requires_grad_()
    value, expected = ssim(fast, b.cuda()), ssim_reference(slow, b.double())
    value.backward()
    expected.backward()
    assert abs(value.item() - expected.item()) < 1e-5
    assert (fast.grad.cpu() - slow.grad).norm() <= 1e-3 * slow.grad.norm()


# HexPlane, STG, paths with a frozen background, tracking, both spike losses, SPSS, MSDI, the radiance field.
PATHS = ["tfp+static", "tfp+4dgs", "tfp+stg", "tfp+d3dgs", "dy-spikegs", "dy-spikenerf", "spike4dgs-x", "spike4dgs"]


@pytest.mark.parametrize("name", [*PATHS, "tfp+4dgs+spike", "tfp+4dgs+spss"])
def test_each_path_fits_as_on_the_cpu(name: str) -> None:
    world = ToyWorld()
    images = []
    for device in ("cpu", "cuda"):
        METHODS[name].warm_up(FitRequest(device=device))
        model = METHODS[name].fit(world.training, FitRequest(Budget(scale=0.05), device=device))
        images.append(np.stack([model.render(world.held_out, t) for t in (1000.0, 6000.0)]))
    error = np.sqrt(np.mean((images[0] - images[1]) ** 2))
    assert np.isfinite(images[1]).all() and error < 0.03  # chaotic: after some steps only the scene is the same


@pytest.mark.parametrize("name", saved_models.MODELS)
def test_a_saved_model_renders_as_on_the_cpu(name: str, tmp_path: Path) -> None:
    """As `view`, `render` and `score` read it."""
    saved_models.model(name).save(tmp_path / "model", saved_models.provenance())
    on = {device: load_model(tmp_path / "model", device).model for device in ("cpu", "cuda")}
    camera = saved_models.WORLD.cameras[0]
    for t in (0.0, 0.4 * saved_models.DURATION_US):
        np.testing.assert_allclose(on["cuda"].render(camera, t), on["cpu"].render(camera, t), atol=1e-3)


def test_msdi_trains(tmp_path: Path) -> None:
    write_toy_shard(tmp_path, 13, instants=1)
    settings = TrainingSettings(steps=30, views=4, most_views=3, lr_points=4e-3, warm_up=10)
    training = Training(Bursts(open_folder(tmp_path)), TINY, settings, "cuda", seed=1)
    losses = [training.train_step().image_l1 for _ in range(settings.steps)]
    assert np.isfinite(losses).all() and np.mean(losses[-5:]) < np.mean(losses[:5])
