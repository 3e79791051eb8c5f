"""A scene's revision changes with any bit of what is fitted or scored, and with nothing else."""

import hashlib
import io
import math
import shutil
import struct
import tempfile
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import pytest
from changes import edit_json, flip_bit
from hypothesis import example, given, settings
from hypothesis import strategies as st
from PIL import Image

from spike4dgs.benchmark import UserError, open_scene
from spike4dgs.benchmark.files import write_bytes
from spike4dgs.benchmark.scene.content import data_files, hash_arrays
from spike4dgs.benchmark.scene.images import read_channels, read_mask, write_mask
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.spikes.counted_recording import encode_recording

Change = Callable[[Path], None]
CAMERAS = st.sampled_from([f"cam_{i:02d}" for i in range(4)])
TRUTH = "images/cam_03/000020.exr"
MASK = "masks/cam_03/000020.png"


@pytest.fixture(scope="module")
def full(one_full_scene: Path) -> Path:
    return one_full_scene


@pytest.fixture(scope="module")
def first(full: Path) -> str:
    """The revision of the scene as it is."""
    return revision(full)


@contextmanager
def copied(scene: Path) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as folder:
        yield Path(shutil.copytree(scene, Path(folder) / "scene"))


def revision(scene: Path, change: Change | None = None) -> str:
    """The revision of a copy of the scene that was changed, with the manifest that its writer would give it."""
    with copied(scene) as root:
        if change:
            change(root)
            write_manifest(root)
        return open_scene(root, allow_gaps=True).revision


def edit(name: str, change: Callable[[dict[str, Any]], Any]) -> Change:
    return lambda root: edit_json(root / name, change)


def flip(name: str, bit: int) -> Change:
    return lambda root: flip_bit(root / name, bit // 8 % (root / name).stat().st_size, bit % 8)


def recompress(root: Path) -> None:
    for path in root.glob("images/*/*.exr"):
        channels = read_channels(path)
        OpenEXR.File({"compression": OpenEXR.PIZ_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))
    for path in root.glob("masks/*/*.png"):
        with Image.open(path) as image:
            image.load()
            image.save(path, compress_level=0)
    for path in root.glob("truth/*.npz"):
        with np.load(path) as data:
            arrays = dict(reversed(list(data.items())))
        np.savez_compressed(path, **arrays)


def count(root: Path) -> None:
    scene = open_scene(root)
    for camera in scene.cameras:
        found = scene.recordings(camera)
        assert found
        for kind, recording in (("flat", found.flat), ("dark", found.dark)):
            write_bytes(root / f"calibration/{kind}/{camera}.npz", encode_recording(recording))
            (root / f"calibration/{kind}/{camera}.dat").unlink()


def touched(values: float) -> float:
    return math.nextafter(values, math.inf)


SAME: dict[str, Change] = {
    "texts": lambda root: (root / "README.md").write_text("another text") and None,
    "preview": lambda root: (root / "preview.webp").write_bytes(b"RIFF") and None,
    "versions": edit("scene.json", lambda m: m["source"].update(versions={"numpy": "99.0"})),
    "title": edit("scene.json", lambda m: m.update(title="Another", licence="CC-BY-4.0", id="other")),
    "other sensors": lambda root: [shutil.rmtree(root / name) for name in ("events", "conventional")] and None,
    "facts of other sensors": edit("scene.json", lambda m: m["events"].update(threshold=0.25)),
    "catalogue": lambda root: (root / "croissant.json").unlink(),
    "COLMAP": lambda root: shutil.rmtree(root / "sparse"),
    "geometry": lambda root: shutil.rmtree(root / "geometry"),
    "all images": edit("transforms_all.json", lambda t: t["frames"].clear()),
    "names of images": edit("transforms_test.json", lambda t: [f.update(file_path="x") for f in t["frames"]]),
    "encodings": recompress,
    "counted recordings": count,
    "a reason": edit("scene.json", lambda m: m["sync"].update(note="checked")),
}


@pytest.mark.parametrize("change", SAME.values(), ids=SAME)
def test_what_is_neither_fitted_nor_scored_does_not_change_the_revision(full: Path, first: str, change: Change) -> None:
    assert revision(full, change) == first


def test_encodings_did_change_the_bytes(full: Path) -> None:
    with copied(full) as root:
        recompress(root)
        for name in (TRUTH, MASK, "truth/cam_00.npz"):
            assert (root / name).read_bytes() != (full / name).read_bytes(), name


@settings(max_examples=8, deadline=None)
@given(camera=CAMERAS, bit=st.integers(0, 80 * 120 * 8 - 1))
def test_one_bit_of_a_stream_is_another_revision(full: Path, first: str, camera: str, bit: int) -> None:
    assert revision(full, flip(f"spikes/{camera}.dat", bit)) != first


@settings(max_examples=3, deadline=None)
@given(camera=CAMERAS, y=st.integers(0, 23), x=st.integers(0, 39))
def test_one_pixel_of_truth_is_another_revision(full: Path, first: str, camera: str, y: int, x: int) -> None:
    def half(root: Path) -> None:
        channels = read_channels(root / TRUTH)
        channels["Y"].view(np.uint16)[y, x] ^= 1
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, channels).write(str(root / TRUTH))

    def mask(root: Path) -> None:
        region = np.array(read_mask(root / MASK))
        region[y, x] ^= True
        write_mask(root / MASK, region)

    def gain(root: Path) -> None:
        path = root / f"truth/{camera}.npz"
        with np.load(path) as data:
            arrays = dict(data)
        arrays["gain"].view(np.uint32)[y, x] ^= 1
        np.savez(path, **arrays)

    found = [revision(full, change) for change in (half, mask, gain)]
    assert len({first, *found}) == 4


def counts_of(spikes: np.ndarray[Any, Any]) -> tuple[Any, ...]:
    """All that a calibration reads, from plain spikes [T, H, W]."""
    fired = spikes.any(axis=0)
    first = np.where(fired, spikes.argmax(axis=0), -1)
    last = np.where(fired, len(spikes) - 1 - spikes[::-1].argmax(axis=0), -1)
    whole = spikes[: len(spikes) // 50 * 50].reshape(-1, 50, *spikes.shape[1:])
    return tuple(a.tobytes() for a in (first, last, spikes.sum(axis=0), whole.sum(axis=1)))


@settings(max_examples=10, deadline=None)
@given(kind=st.sampled_from(["flat", "dark"]), camera=CAMERAS, bit=st.integers(0, 129 * 960 - 1), moved=st.booleans())
@example(kind="flat", camera="cam_00", bit=12345, moved=True)
def test_a_recording_counts_by_what_a_calibration_reads_of_it(
    full: Path, first: str, kind: str, camera: str, bit: int, moved: bool
) -> None:
    """A spike more or less, or one that only moves to its pixel's next tick."""
    name = f"calibration/{kind}/{camera}.dat"
    before = np.unpackbits(np.fromfile(full / name, np.uint8), bitorder="little").reshape(-1, 24, 40)
    after = before.copy()
    if moved:  # in the middle of the first window
        movable = 10 * 960 + np.flatnonzero(before[10:40] > before[11:41])
        bit = int(movable[bit % len(movable)])
    after.reshape(-1)[[bit, bit + 960] if moved else bit] ^= 1

    def write(root: Path) -> None:
        np.packbits(after, bitorder="little").tofile(root / name)

    assert (revision(full, write) == first) == (counts_of(before) == counts_of(after))


def moved(by: Callable[[float], float], *where: tuple[str, str, int]) -> Change:
    """Change numbers of poses and lenses that have nine decimals: of these cameras, keys and indices of a matrix."""

    def change(root: Path) -> None:
        for name in ("transforms_train.json", "transforms_test.json"):
            edit_json(root / name, lambda transforms: [of_frame(frame) for frame in transforms["frames"]])

    def of_frame(frame: dict[str, Any]) -> None:
        for camera, key, index in where:
            if frame["camera"] == camera and key == "transform_matrix":
                row = frame[key][index // 4]
                row[index % 4] = by(round(row[index % 4], 9))
            elif frame["camera"] == camera:
                frame[key] = by(round(frame[key], 9))

    return change


NUMBERS = [("cam_00", "fl_x", 0), ("cam_01", "fl_y", 0), ("cam_02", "cx", 0), ("cam_03", "cy", 0)]
NUMBERS += [(f"cam_{i % 4:02d}", "transform_matrix", i) for i in (0, 3, 6, 9)]


def test_a_pose_or_lens_counts_to_nine_decimals(full: Path) -> None:
    exact = revision(full, moved(lambda v: v, *NUMBERS))
    for less in (touched, lambda v: v - 1e-12):
        assert revision(full, moved(less, *NUMBERS)) == exact
    found = [revision(full, moved(lambda v: v + 2e-9, number)) for number in NUMBERS]
    assert len({exact, *found}) == 1 + len(NUMBERS)


OTHER: dict[str, Change] = {
    "a target more": edit("targets.json", lambda t: t["targets"].append({"camera": "cam_03", "tick": 50})),
    "a target of another split": edit("targets.json", lambda t: t["splits"]["corner"].pop()),
    "another split": edit("scene.json", lambda m: m["splits"].update(two={"train": ["cam_00"], "test": ["cam_03"]})),
    "the order of training views": edit("scene.json", lambda m: m["splits"]["center"]["train"].reverse()),
    "rate": edit("scene.json", lambda m: m.update(rate_hz=touched(m["rate_hz"]))),
    "gain": edit("scene.json", lambda m: m.update(radiance_gain=touched(m["radiance_gain"]))),
    "light of the calibration": edit("scene.json", lambda m: m["calibration"].update(flat_radiance=0.75)),
    "order of rows": edit("scene.json", lambda m: m["sensor"].update(rows_bottom_up=False)),
    "a gap": edit(
        "scene.json", lambda m: m.update(gaps=[{"camera": "cam_00", "first_tick": 3, "ticks": 2, "reason": "usb"}])
    ),
    "lens": edit("transforms_train.json", lambda t: [f.update(k1=0.01) for f in t["frames"]]),
    "an image less": lambda root: (root / "images/cam_00/000030.exr").unlink(),
    "swapped streams": lambda root: swap(root / "spikes/cam_00.dat", root / "spikes/cam_01.dat"),
    "swapped truth": lambda root: swap(root / TRUTH, root / "images/cam_03/000040.exr"),
}


def swap(a: Path, b: Path) -> None:
    kept = a.read_bytes()
    a.write_bytes(b.read_bytes())
    b.write_bytes(kept)


def test_what_is_fitted_or_scored_changes_the_revision(full: Path, first: str) -> None:
    found = {name: revision(full, change) for name, change in OTHER.items()} | {"unchanged": first}
    assert len(set(found.values())) == len(found), sorted(found.items(), key=lambda item: item[1])


def test_a_manifest_without_contents_gives_the_same_revision(full: Path, first: str) -> None:
    with copied(full) as root:
        edit("manifest.json", lambda m: [facts.pop("content", None) for facts in m["files"].values()])(root)
        assert open_scene(root).revision == first
        (root / TRUTH).write_bytes(b"damaged")
        with pytest.raises(UserError, match="000020.exr"):
            _ = open_scene(root).revision


def test_part_of_a_scene_knows_its_revision(full: Path, first: str) -> None:
    with copied(full) as root:
        for folder in ("spikes", "images", "masks", "calibration", "truth", "events", "conventional"):
            shutil.rmtree(root / folder)
        assert open_scene(root).revision == first


def test_two_files_of_one_recording_are_refused(full: Path) -> None:
    with copied(full) as root:
        shutil.copy(root / "truth/cam_00.npz", root / "calibration/flat/cam_00.npz")
        write_manifest(root)
        with pytest.raises(UserError, match="one file of a recording"):
            _ = open_scene(root).revision


def test_the_hash_of_arrays_is_the_documented_one() -> None:
    values = np.array([[1.5, -0.0], [math.inf, 2.0]], ">f2")
    expected = hashlib.sha256(b'["Y", "<f2", [2, 2]]\n' + struct.pack("<4e", 1.5, -0.0, math.inf, 2.0))
    expected.update(b'["n", "|u1", []]\n\x07')
    assert hash_arrays({"n": np.array(7, np.uint8), "Y": values}) == expected.hexdigest()
    assert hash_arrays({"Y": np.asfortranarray(values)}) == hash_arrays({"Y": values})
    assert hash_arrays({"Y": values}) != hash_arrays({"Y": values.reshape(1, 4)})
    assert hash_arrays({"Y": values}) != hash_arrays({"Y": values.astype(np.float32)})


def test_the_data_are_named_by_camera_and_tick() -> None:
    other = ["README.md", "images/a/thumb.png", "geometry/a/000020.exr", "calibration/maps/a.npz"]
    found = data_files([*other, "images/a/000020.exr", "calibration/dark/a.npz", "s.dat"], {"a": "s.dat"})
    kept = {"images/a/000020": "images/a/000020.exr", "calibration/dark/a": "calibration/dark/a.npz"}
    assert found == kept | {"spikes/a": "s.dat"}


def test_a_damaged_archive_is_named(full: Path) -> None:
    with copied(full) as root:
        with zipfile.ZipFile(archive := io.BytesIO(), "w") as file:
            file.writestr("gain.npy", b"no array")
        for data in (b"", b"PK\x03\x04 no archive", archive.getvalue()):
            (root / "truth/cam_00.npz").write_bytes(data)
            write_manifest(root)
            with pytest.raises(UserError, match="cam_00.npz: expected the arrays of a scene"):
                _ = open_scene(root).revision
