from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from full_scene import write_full_scene
from small_scenes import HEIGHT, TICKS, WIDTH, write_small_scene

from spike4dgs.benchmark.scene.images import read_exr, write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.scene_differences import bits_that_differ, block_means, difference, images_of


def opened(root: Path) -> Scene:
    write_manifest(root)
    return open_scene(root)


def test_a_scene_does_not_differ_from_itself(tmp_path: Path) -> None:
    scene = open_scene(write_full_scene(tmp_path / "scene"))
    found = difference(scene, scene, "cam_03")
    assert (found.bits, found.spikes_block_rms, found.truth_rms, found.truth_block_max) == (0, 0, 0, 0)
    assert found.truth_db is None and difference(scene, scene, "cam_01").truth_rms is None
    assert [t.tick for t in images_of(scene, "cam_03")] == [20, 40, 60]


def test_bits_are_those_of_plain_arrays() -> None:
    rng = np.random.default_rng(0)
    a, b = rng.random((2, 700, 5, 7)) < 0.3
    streams = [SpikeStream(pack(x), 7, 5, 20000.0) for x in (a, b)]
    assert math.isclose(bits_that_differ(*streams), np.mean(a != b))


def test_a_known_change_of_truth_is_measured(tmp_path: Path) -> None:
    a, b = open_scene(write_small_scene(tmp_path / "a")), write_small_scene(tmp_path / "b")
    for path in b.glob("images/cam_03/*.exr"):
        image = np.array(read_exr(path))
        image[8:16, 16:24] += 0.125
        write_exr(path, image, 0.0)
    found = difference(a, opened(b), "cam_03")
    share = 64 / (HEIGHT * WIDTH)
    assert found.truth_rms == pytest.approx(0.125 * math.sqrt(share), rel=0.01)
    assert found.truth_block_max == pytest.approx(0.125, rel=0.01)
    assert found.truth_block_rms == pytest.approx(0.125 * math.sqrt(share), rel=0.01)
    assert found.truth_db == pytest.approx(-20 * math.log10(0.125 * math.sqrt(share)), abs=0.1)
    assert found.bits == 0


def test_a_silent_block_of_spikes_is_measured(tmp_path: Path) -> None:
    a, b = open_scene(write_small_scene(tmp_path / "a")), write_small_scene(tmp_path / "b")
    spikes = open_scene(b).stream("cam_00").window(0, TICKS)
    silent = spikes.copy()
    silent[:, 8:16, 16:24] = 0
    (b / "spikes/cam_00.dat").write_bytes(pack(silent).tobytes())
    found = difference(a, opened(b), "cam_00")
    lost = spikes[:, 8:16, 16:24].mean()
    assert found.bits == pytest.approx(spikes[:, 8:16, 16:24].sum() / spikes.size)
    assert found.spikes_block_max == pytest.approx(lost)
    assert found.spikes_block_rms == pytest.approx(lost / math.sqrt(15))


def test_block_means_leave_out_what_is_over() -> None:
    image = np.arange(20.0 * 17).reshape(20, 17)
    found = block_means(image)
    assert found.shape == (2, 2) and found[1, 1] == image[8:16, 8:16].mean()
