"""The memory of a fit's first steps does not grow with the clip, but for the trains of one stream."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from memory import STATUS, peak_bytes, resident_bytes

from spike4dgs.benchmark.scene.scene import TrainingScene
from spike4dgs.benchmark.spikes.stream import SpikeWriter, open_stream
from spike4dgs.benchmark.spikes.trains import trains_bytes
from spike4dgs.method.images.base import ImageMaker
from spike4dgs.method.images.intervals import INTERVALS
from spike4dgs.method.images.training import ImageSettings, make_training_images
from spike4dgs.method.starts.rig import rig
from spike4dgs.method.training_views.warm_up_scene import warm_up_scene

SETTINGS = ImageSettings(max_times=5)


def repeated(times: int) -> TrainingScene:
    """Return the made scene with its clip so many times, one after the other."""
    scene = warm_up_scene()[0]
    streams = tuple(replace(s, packed=np.tile(s.packed, (times, 1))) for s in scene.streams)
    return replace(scene, streams=streams, n_ticks=times * scene.n_ticks)


def images_of(scene: TrainingScene, maker: ImageMaker = INTERVALS) -> object:
    return make_training_images(scene, scene.cameras, maker, SETTINGS, "cpu")


def test_images_of_a_long_clip_take_the_trains_of_one_stream_more() -> None:
    short, long = repeated(1), repeated(80)
    images_of(short)  # compiles
    more = peak_bytes(lambda: images_of(long)) - peak_bytes(lambda: images_of(short))
    trains, spikes = trains_bytes(long.streams[0]), int(sum(s.counts(0, s.n_ticks).sum() for s in long.streams))
    assert 0 < more < 1.5 * trains < spikes, "less than a byte for each spike"


def test_first_points_of_a_long_clip_take_no_more() -> None:
    short, long = repeated(1), repeated(80)
    rig(short)
    assert peak_bytes(lambda: rig(long)) < 1.1 * peak_bytes(lambda: rig(short))


@pytest.mark.skipif(not STATUS.is_file(), reason="Linux says how much of a file is in memory")
def test_images_and_points_leave_no_pages_of_the_streams_in_memory(tmp_path: Path) -> None:
    made = repeated(80)
    mapped = []
    for camera, s in zip(made.cameras, made.streams, strict=True):
        with SpikeWriter(tmp_path / camera.id, s.width, s.height) as writer:
            writer.write(np.tile(s.packed, (2, 1)))
        mapped.append(open_stream(tmp_path / camera.id, s.width, s.height, s.rate_hz))
    scene = replace(made, streams=tuple(mapped), n_ticks=2 * made.n_ticks)
    rig(scene)
    images_of(scene)
    before = resident_bytes("RssFile")
    rig(scene)
    images_of(scene)
    assert resident_bytes("RssFile") - before < 1_000_000
    assert all(stream.packed.any(axis=1).any() for stream in mapped)
    assert resident_bytes("RssFile") - before > 8_000_000, "what is read counts"
