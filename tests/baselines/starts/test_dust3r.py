from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from torch import Tensor
from toy_world import ToyWorld

from spike4dgs.baselines.starts import dust3r as module
from spike4dgs.baselines.starts.dust3r import Dust3rSettings, Pair, dust3r, predictor, resized, solve
from spike4dgs.baselines.starts.dust3r_network import Dust3r, Dust3rShape, canonical, load_dust3r
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.pose_error import pose_errors
from spike4dgs.benchmark.weights import WeightsError
from spike4dgs.method.msdi.layers import rotate
from spike4dgs.method.starts.structure_from_motion import clip_means

TINY = Dust3rShape(2, 32, 2, 4, 24, 2, 16, (4, 6, 8, 12), 16)
SMALL = Dust3rSettings(long_side_px=96)
WORLD = ToyWorld(width=100, height=62, n_ticks=40, travel=0.0, seed=2)


def tiny(seed: int = 0) -> Dust3r:
    torch.manual_seed(seed)
    return Dust3r(TINY).eval().requires_grad_(False)


def test_the_published_shape_has_the_published_number_of_parameters() -> None:
    with torch.device("meta"):
        network = Dust3r()
    assert sum(p.numel() for p in network.parameters()) == 571_170_440  # "571M", 2.28 GB of float32
    names = network.state_dict()
    for name, shape in {
        "patch_embed.proj.weight": (1024, 3, 16, 16),
        "enc_blocks.23.attn.qkv.weight": (3072, 1024),
        "decoder_embed.weight": (768, 1024),
        "dec_blocks2.11.cross_attn.projk.bias": (768,),
        "dec_blocks.0.norm_y.weight": (768,),
        "downstream_head2.dpt.act_postprocess.0.1.weight": (96, 96, 4, 4),
        "downstream_head1.dpt.scratch.layer_rn.3.weight": (256, 768, 3, 3),
        "downstream_head1.dpt.scratch.refinenet4.resConfUnit1.conv1.bias": (256,),
        "downstream_head1.dpt.head.4.weight": (4, 128, 1, 1),
    }.items():
        assert tuple(names[name].shape) == shape, name


def test_rotation_equals_a_loop_over_pairs_and_depends_on_differences_of_places() -> None:
    g = torch.Generator().manual_seed(0)
    x, positions = torch.randn(1, 2, 6, 16, generator=g), torch.cartesian_prod(torch.arange(2), torch.arange(3))
    out = rotate(x, positions)
    for n, position in enumerate(positions.tolist()):
        for half, at in enumerate(position):
            for i in range(4):
                a, b = 8 * half + i, 8 * half + i + 4
                z = torch.complex(x[..., n, a], x[..., n, b]) * np.exp(1j * at * 100 ** (-i / 4))
                assert torch.allclose(out[..., n, a], z.real.float(), atol=1e-5)
                assert torch.allclose(out[..., n, b], z.imag.float(), atol=1e-5)
    q, k = torch.randn(2, 1, 1, 1, 16, generator=g)

    def score(at: tuple[int, int], to: tuple[int, int]) -> Tensor:
        return (rotate(q, torch.tensor([at])) * rotate(k, torch.tensor([to]))).sum()

    assert torch.allclose(score((1, 2), (4, 3)), score((6, 9), (9, 10)), atol=1e-4)


def test_network_gives_points_and_confidence_per_pixel_also_for_odd_counts_of_patches() -> None:
    network = tiny()
    for size in ((48, 80), (32, 64)):
        images = torch.randn(2, 3, *size)
        tokens = network.encode(images)
        assert tokens.shape == (2, size[0] * size[1] // 256, 32)
        for points, confidence in network.decode(tokens[:1], tokens[1:], images[:1]):
            assert points.shape == (1, *size, 3) and confidence.shape == (1, *size)
            assert torch.isfinite(points).all() and (confidence > 1).all()


def test_both_decoders_see_the_other_image_and_have_weights_of_their_own() -> None:
    network, images = tiny(), torch.randn(3, 3, 32, 48)
    tokens = network.encode(images)
    (a1, _), (b1, _) = network.decode(tokens[:1], tokens[1:2], images[:1])
    (a2, _), (b2, _) = network.decode(tokens[:1], tokens[2:], images[:1])
    (swapped, _), _ = network.decode(tokens[1:2], tokens[:1], images[:1])
    assert not torch.allclose(a1, a2) and not torch.allclose(b1, b2) and not torch.allclose(swapped, b1)


def published(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """The names of the published file: the head's layers under their other names, and what is not needed."""
    names = {name.replace("layer_rn.0", "layer1_rn").replace("layer_rn.2", "layer3_rn"): t for name, t in state.items()}
    return {**names, "mask_token": torch.zeros(1, 1, 24)}


def test_weights_load_by_their_published_names(tmp_path: Path) -> None:
    network = tiny(1)
    save_file({k: v.clone() for k, v in published(network.state_dict()).items()}, tmp_path / "model.safetensors")
    loaded = load_dust3r(tmp_path / "model.safetensors", TINY)
    images = torch.randn(2, 3, 32, 48)
    tokens = network.encode(images)
    assert torch.equal(loaded.encode(images), tokens)
    results = (n.decode(tokens[:1], tokens[1:], images) for n in (loaded, network))
    for a, b in zip(*results, strict=True):
        assert torch.equal(a[0], b[0]) and torch.equal(a[1], b[1])
    assert set(canonical({"dpt.act_2_postprocess.0.bias": torch.zeros(1)})) == {"dpt.act_postprocess.1.0.bias"}


def test_other_weights_and_damaged_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    path.write_bytes(b"\x80\x02pickle")
    with pytest.raises(UserError, match="expected weights in safetensors format"):
        load_dust3r(path, TINY)
    state = {k: v.clone() for k, v in tiny().state_dict().items()}
    del state["dec_norm.bias"]
    save_file(state, path)
    with pytest.raises(UserError, match="found 1 other tensors, the first dec_norm.bias missing"):
        load_dust3r(path, TINY)


def test_without_weights_the_reason_names_the_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("SPIKE4DGS_DUST3R", raising=False)
    with pytest.raises(WeightsError, match="2.28 GB, licence CC BY-NC-SA 4.0.*SPIKE4DGS_DUST3R not set"):
        dust3r(WORLD.training, 0)
    monkeypatch.setenv("SPIKE4DGS_DUST3R", str(tmp_path / "absent"))
    with pytest.raises(WeightsError, match="found no such file"):
        dust3r(WORLD.training, 0)


def test_the_whole_path_runs_from_a_file_of_tiny_random_weights(monkeypatch, tmp_path: Path) -> None:
    save_file(tiny().state_dict(), tmp_path / "tiny.safetensors")
    monkeypatch.setenv("SPIKE4DGS_DUST3R", str(tmp_path / "tiny.safetensors"))
    monkeypatch.setattr(module, "load_dust3r", lambda path: load_dust3r(path, TINY))
    scene = WORLD.training
    few = replace(scene, cameras=scene.cameras[:3], streams=scene.streams[:3])
    try:
        start = dust3r(few, 0, SMALL)
    except UserError as e:  # random points seldom have a pose
        assert "found no consistent points" in str(e) or "cameras at different positions" in str(e)
    else:
        assert len(start.cameras) == 3 and np.isfinite(start.points).all()


def test_resized_view_sees_the_same_scene() -> None:
    camera = WORLD.cameras[1]
    view = resized(camera, 16, 512)
    assert (view.width, view.height) == (512, 304)
    points = camera.unproject(np.array([[10.0, 20.0], [50.0, 31.0]]), np.array([2.0, 3.0]))
    middle, half = np.array([256, 152]), np.array([50, 31])
    assert np.allclose(view.project(points)[0] - middle, 5.12 * (camera.project(points)[0] - half))
    v, u = np.mgrid[:62, :100] + 0.5
    image = (0.2 + 0.005 * u + 0.003 * v).astype(np.float32)
    shown = module._decode_srgb(module._resize(image, view, 512))[8:-8, 8:-8]
    y, x = np.mgrid[8:296, 8:504] + 0.5
    expected = 0.2 + 0.005 * (50 + (x - 256) / 5.12) + 0.003 * (31 + (y - 152) / 5.12)
    assert np.abs(shown - expected).max() < 0.005 and abs((shown - expected).mean()) < 5e-4  # 8 bits; 0.1 px


@pytest.mark.parametrize("calibrated", [True, False])
def test_perfect_points_at_scales_of_their_own_give_the_poses(calibrated: bool) -> None:
    scene, rng = WORLD.training, np.random.default_rng(0)
    views = [resized(c, 16, SMALL.long_side_px) for c in scene.cameras]
    shown = np.stack([module._resize(p, v, SMALL.long_side_px) for p, v in zip(clip_means(scene), views, strict=True)])

    def seen(i: int) -> np.ndarray:
        v, u = np.mgrid[: views[0].height, : views[0].width] + 0.5
        depth = WORLD.trace(views[i], 0.5)[1]
        points = views[i].unproject(np.column_stack([u.ravel(), v.ravel()]), depth.ravel())
        return (points @ views[0].R.T + views[0].t).reshape(*depth.shape, 3)

    def predict(other: int) -> Pair:
        scale, sure = np.exp(rng.normal()), np.ones((views[0].height, views[0].width))
        points = [scale * (seen(i) + 1e-3 * rng.normal(size=seen(i).shape)) for i in (0, other)]
        return Pair((points[0], points[1]), (sure, sure))

    start = solve(predict, views, shown, scene, 0, SMALL, calibrated=calibrated)
    summary = pose_errors(start.cameras, scene.cameras).summary()
    assert summary["rotation_max_deg"] < 0.1 and summary["translation_of_array"] < 0.01
    assert start.cameras[4].fx == pytest.approx(scene.cameras[4].fx, rel=1e-9 if calibrated else 2e-3)
    uv, z = WORLD.held_out.project(start.points.astype(np.float64))
    inside = (uv >= 0).all(axis=1) & (uv < [100, 62]).all(axis=1)
    u, v = uv[inside].astype(int).T
    image, depth, _ = WORLD.trace(WORLD.held_out, 0.5)
    assert np.median(np.abs(z[inside] / depth[v, u] - 1)) < 0.01
    assert np.corrcoef(start.values[inside], image[v, u])[0, 1] > 0.8


def test_one_view_alone_is_refused() -> None:
    scene = replace(WORLD.training, cameras=WORLD.training.cameras[:1], streams=WORLD.training.streams[:1])
    view, shown = resized(scene.cameras[0], 16, SMALL.long_side_px), np.zeros((1, 48, 96), np.float32)
    with pytest.raises(UserError, match="expected two training views or more, found 1"):
        solve(lambda _: pytest.fail("no pair"), [view], shown, scene, 0, SMALL, calibrated=True)


def test_images_reach_the_network_in_its_range() -> None:
    class Recorder(Dust3r):
        seen: list[Tensor] = []

        def encode(self, images: Tensor) -> Tensor:
            self.seen.append(images)
            return super().encode(images)

    shown = np.linspace(0, 1, 2 * 32 * 48, dtype=np.float32).reshape(2, 32, 48)
    pair = predictor(Recorder(TINY).eval(), shown)(1)
    assert Recorder.seen[1].shape == (1, 3, 32, 48)
    assert np.allclose(Recorder.seen[1][0, 2].cpu().numpy(), 2 * shown[1] - 1)
    assert pair.points[1].shape == (32, 48, 3) and pair.confidence[0].shape == (32, 48)
