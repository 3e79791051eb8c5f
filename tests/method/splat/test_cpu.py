"""The CPU kernels against the float64 reference: images, gradients, determinism, errors."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import pytest
import splat_parity
import torch
from hard_case import BYTES, HardCase, core_counts
from hypothesis import given, settings
from hypothesis import strategies as st
from splat_parity import differentiate
from splat_scenes import HARD, changed, far_origin, random_splats, views

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.splat import PixelFilter, Splats, Views, cpu, render, set_threads
from spike4dgs.method.splat.api import Backend
from spike4dgs.method.splat.kernels.threads import work_alone


def compare(splats: Splats, v: Views, **options: bool) -> None:
    splat_parity.compare(splats, v, "cpu", **options)


@pytest.mark.parametrize("scene", [scene for scene in HARD if scene is not far_origin])  # float64 alone resolves that
def test_hard_scenes_in_float32(scene: Callable[[], tuple[Splats, Views]]) -> None:
    splats, v = scene()
    compare(Splats(*(t[:200].float() for t in splats.tensors)), v)


# Kernels exist for 1, 2 and 4 layers: one alone, with the depth, a place left over, full, and more than one pass.
LAYERS = [(1, False), (1, True), (2, False), (2, True), (3, True), (4, False), (4, True), (7, True), (9, False)]


@pytest.mark.parametrize(("channels", "depth"), LAYERS)
def test_any_number_of_channels(channels: int, depth: bool) -> None:
    compare(random_splats(60, channels, seed=20), views(), depth=depth)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10**6), st.integers(1, 120), st.floats(-6, 1), st.floats(-3, 6), st.booleans())
def test_random_scenes(seed: int, n: int, log_size: float, logit: float, antialiased: bool) -> None:
    s = random_splats(n, seed=seed)
    s = changed(s, scales=s.scales * torch.tensor(10.0**log_size), opacities=torch.sigmoid(s.opacities * 4 - 2 + logit))
    compare(s, views(1), antialiased=antialiased)


def test_short_vectors_give_the_same_image(monkeypatch: pytest.MonkeyPatch) -> None:
    """8 lanes (AVX2, NEON, SSE) as well as this machine's choice."""
    monkeypatch.setattr(cpu, "host_lanes", lambda: 8)
    compare(random_splats(150, seed=21), views())


def test_sizes_that_do_not_fill_their_tiles() -> None:
    v = views()
    for width, height in ((1, 1), (65, 33), (64, 32), (7, 70)):
        compare(random_splats(60, seed=22), Views(v.w2c, v.K, width, height))


@pytest.fixture
def restore_threads():
    yield
    set_threads(2)


@pytest.mark.hard_case(asked="render and differentiate 3,000 Gaussians", twin="one thread", **BYTES, kind="threads")
def test_threads(restore_threads: None, hard_case: HardCase) -> None:
    splats, v = random_splats(3000, seed=23), views()
    results, counts = [], [1, 2, 2, *core_counts()[1:], core_counts()[-1] + 1]
    for threads in counts:
        set_threads(threads)
        out, grads = differentiate(splats, v, "cpu", torch.ones(2, v.height, v.width), True)
        tensors = (out.image, out.alpha, out.depth, out.radii, *grads.values())
        results.append(b"".join(x.detach().contiguous().numpy().tobytes() for x in tensors))
    hard_case.same_bytes(results, [f"{n} threads" for n in counts])


def test_threads_that_render_at_once_do_not_disturb_one_another() -> None:
    """One of them with helpers, the others alone, as a fit's corrections are made."""
    scenes, v = [random_splats(400, seed=s) for s in range(4)], views()

    def values(k: int) -> list[torch.Tensor]:
        out, grads = differentiate(scenes[k], v, "cpu", torch.ones(2, v.height, v.width), True)
        return [out.image, out.alpha, out.depth, *grads.values()]

    expected = [values(k) for k in range(4)]

    def same(k: int) -> bool:
        if k:
            work_alone()
        return all(torch.equal(a, b) for _ in range(20) for a, b in zip(values(k), expected[k], strict=True))

    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(same, range(4)))


def test_nothing_is_differentiated_without_need() -> None:
    out = render(random_splats(20), views())
    assert not out.image.requires_grad and not out.means2d.requires_grad
    v = views()  # and poses alone, if it is they that are trained
    trained = Views(v.w2c.clone().requires_grad_(), v.K, v.width, v.height)
    render(random_splats(20), trained).image.sum().backward()
    assert trained.w2c.grad is not None and trained.w2c.grad[:, :3].abs().sum() > 0


def test_one_line_errors() -> None:
    s, v = random_splats(5), views()
    with pytest.raises(UserError, match=r"Splats.quats: expected shape \(5, 4\), found \(4, 4\)"):
        Splats(s.means, s.quats[:4], s.scales, s.opacities, s.colors)
    with pytest.raises(UserError, match="camera"):
        Views(v.w2c[:0], v.K[:0], 10, 10)
    with pytest.raises(UserError, match="variance"):
        render(s, v, PixelFilter(-0.1))
    with pytest.raises(UserError, match="backend"):
        render(s, v, backend="opengl")  # type: ignore[arg-type]
    for name in ("means", "quats", "scales", "opacities", "colors"):
        broken = getattr(s, name).clone()
        broken[3] = float("nan")
        for backend in ("cpu", "reference"):
            with pytest.raises(UserError, match="finite"):
                render(changed(s, **{name: broken}), v, backend=backend)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["w2c", "K"])
@pytest.mark.parametrize("backend", ["cpu", "reference"])
def test_a_camera_that_is_not_finite_is_no_empty_image(name: str, backend: Backend) -> None:
    v = views()
    broken = {n: getattr(v, n).clone() for n in ("w2c", "K")}
    broken[name][1, 0, 0] = float("nan")
    with pytest.raises(UserError, match=f"Views.{name}: expected finite numbers, found NaN or infinity at camera 1"):
        render(random_splats(5), Views(**broken, width=v.width, height=v.height), backend=backend)


def test_an_image_that_was_changed_in_place_has_no_wrong_gradient() -> None:
    """The kernels' gradient is made from the image; torch must notice that it is another one now."""
    splats = random_splats(60)
    splats = Splats(*(t.requires_grad_() for t in splats.tensors))
    image = render(splats, views(), backend="cpu").image
    image += 0.5
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        image.square().sum().backward()
