"""Fingerprints of scenes: rounding is recognised, another noise and another world are not."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binom
from small_scenes import TICKS, write_small_scene

from spike4dgs.benchmark import Scene, UserError, open_scene
from spike4dgs.benchmark.release import fingerprint as module
from spike4dgs.benchmark.release.fingerprint import compare, make_fingerprint, read_fingerprint, write_fingerprint
from spike4dgs.benchmark.scene.images import read_exr, write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest

Change = Callable[[Path], None]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    return open_scene(write_small_scene(tmp_path_factory.mktemp("scene") / "scene"))


def changed(scene: Scene, folder: Path, change: Change) -> Scene:
    """A copy of the scene after a change of its files."""
    shutil.copytree(scene.root, folder)
    change(folder)
    write_manifest(folder)
    return open_scene(folder)


def streams(change: Callable[[np.ndarray], None], *cameras: str) -> Change:
    """A change of the unpacked bits [ticks, pixels] of some streams."""

    def on_disk(root: Path) -> None:
        for camera in cameras:
            path = root / f"spikes/{camera}.dat"
            bits = np.unpackbits(np.fromfile(path, np.uint8), bitorder="little").reshape(TICKS, -1)
            change(bits)
            np.packbits(bits, bitorder="little").tofile(path)

    return on_disk


def flip(share: float) -> Callable[[np.ndarray], None]:
    def change(bits: np.ndarray) -> None:
        bits ^= np.random.default_rng(0).random(bits.shape) < share

    return change


def one_tick_later(bits: np.ndarray) -> None:
    bits[:] = np.roll(bits, 1, axis=0)


def dark_corner(bits: np.ndarray) -> None:
    bits.reshape(TICKS, 24, 40)[:50, :8, :8] = 0


def truth(change: Callable[[np.ndarray], np.ndarray]) -> Change:
    def on_disk(root: Path) -> None:
        path = root / "images/cam_03/000040.exr"
        write_exr(path, change(read_exr(path, (24, 40))).astype(np.float32), 2000.0)

    return on_disk


def last_bits(image: np.ndarray) -> np.ndarray:
    """Every tenth half float is the next larger one."""
    larger = np.nextafter(np.float16(image), np.float16(2))
    return np.where(np.arange(image.size).reshape(image.shape) % 10, image, larger)


def test_a_scene_is_equivalent_to_itself_through_the_file(scene: Scene, tmp_path: Path) -> None:
    found = make_fingerprint(scene)
    write_fingerprint(tmp_path / "a.npz", found)
    write_fingerprint(tmp_path / "b.npz", make_fingerprint(scene))
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    match = compare(scene, read_fingerprint(tmp_path / "a.npz"))
    assert match.is_equivalent and match.bits == 0 and match.revision == scene.revision == found.revision
    blocks = found.arrays["spikes/cam_00"]  # 2 parts of the clip, 3x5 blocks of 8x8 pixels
    counts = scene.stream("cam_00").counts(0, 50).astype(int)
    assert blocks.shape == (2, 3, 5)
    assert np.array_equal(blocks[0], counts.reshape(3, 8, 5, 8).sum((1, 3)))
    means = found.arrays["truth/cam_03/000040"] / 65535
    expected = np.clip(scene.ground_truth(scene.targets[1]), 0, 1).reshape(3, 8, 5, 8).mean((1, 3))
    np.testing.assert_allclose(means, expected, atol=1 / 65535)


@pytest.mark.parametrize("change", [streams(flip(1e-4), "cam_00", "cam_01"), truth(last_bits)], ids=["bits", "truth"])
def test_rounding_is_equivalent_in_another_revision(scene: Scene, tmp_path: Path, change: Change) -> None:
    other = changed(scene, tmp_path / "scene", change)
    match = compare(other, make_fingerprint(scene))
    assert other.revision != scene.revision == match.revision
    assert match.is_equivalent, match.reasons
    assert match.bits < 0.01


def pose(root: Path) -> None:
    path = root / "transforms_train.json"
    content = json.loads(path.read_text())
    content["frames"][0]["transform_matrix"][0][3] += 1e-3
    path.write_text(json.dumps(content))


def clock(root: Path) -> None:
    path = root / "scene.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"radiance_gain": 0.61}))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (streams(flip(0.1), "cam_00", "cam_01", "cam_02", "cam_03"), "of the spike bits differ, 1% at most"),
        (streams(one_tick_later, "cam_00", "cam_01", "cam_02", "cam_03"), "of the spike bits differ"),
        (streams(dark_corner, "cam_02"), "spikes/cam_02: blocks differ"),
        (truth(lambda image: image * 1.01), "truth/cam_03/000040: blocks differ"),
        (truth(lambda image: np.roll(image, 1, 1)), "truth/cam_03/000040: blocks differ"),
        (pose, "another camera cam_00"),
        (clock, "another radiance_gain"),
    ],
    ids=["noise", "one tick", "one block", "brighter", "shifted", "pose", "clock"],
)
def test_another_noise_or_world_is_not(scene: Scene, tmp_path: Path, change: Change, reason: str) -> None:
    match = compare(changed(scene, tmp_path / "scene", change), make_fingerprint(scene))
    assert not match.is_equivalent and any(reason in line for line in match.reasons)


def test_a_changed_part_of_the_moving_region_is_noticed(scene: Scene, tmp_path: Path) -> None:
    def all_moves(root: Path) -> None:
        shutil.copy(root / "masks/cam_03/000020.png", root / "masks/cam_03/000040.png")
        from spike4dgs.benchmark.scene.images import write_mask

        write_mask(root / "masks/cam_03/000040.png", np.ones((24, 40), bool))

    match = compare(changed(scene, tmp_path / "scene", all_moves), make_fingerprint(scene))
    assert any("masks/cam_03/000040: other pixels move" in reason for reason in match.reasons)


@pytest.mark.parametrize(("differing", "total"), [(0, 1000), (3, 10_000), (100, 16_384)])
def test_the_bound_is_where_so_few_bits_become_improbable(differing: int, total: int) -> None:
    assert binom.cdf(differing, total, module._bound(differing, total)) == pytest.approx(1e-3, rel=1e-6)


@pytest.mark.parametrize(("height", "width", "ticks"), [(125, 200, 400), (250, 400, 2000), (250, 400, 20_000)])
def test_a_scene_of_any_size_has_few_blocks(height: int, width: int, ticks: int) -> None:
    assert module._block_sums(np.ones((height, width), int)).size <= 1000
    assert module._block_sums(np.ones((height, width), int)).sum() == height * width
    spans = module._periods(ticks)
    assert len(spans) <= 10 and spans[0][0] == 0 and spans[-1][1] == ticks
    assert all(a[1] == b[0] for a, b in zip(spans, spans[1:], strict=False))


def test_damaged_files_and_other_formats_are_one_clear_error(tmp_path: Path) -> None:
    for content in (b"", b"PK\x03\x04", b"not a zip"):
        (tmp_path / "f.npz").write_bytes(content)
        with pytest.raises(UserError, match=r"f\.npz: expected a fingerprint"):
            read_fingerprint(tmp_path / "f.npz")
    np.savez(tmp_path / "f.npz", head=np.frombuffer(b'{"format": "other"}', np.uint8))
    with pytest.raises(UserError, match="format 'other'"):
        read_fingerprint(tmp_path / "f.npz")
