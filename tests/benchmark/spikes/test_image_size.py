"""Sizes are proposed by length and by rows that agree; right sizes raise no doubt."""

import numpy as np
import pytest
from small_scenes import shared_file

from spike4dgs.benchmark.spikes.image_size import KNOWN_SIZES, fitting_sizes, row_agreement, size_doubt
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.generators.profiles import PROFILES


def scene(width: int, height: int, ticks: int = 100, seed: int = 0) -> np.ndarray:
    """Random spikes of smooth light with an edge, [T, H, W]."""
    y, x = np.mgrid[:height, :width]
    rate = 0.3 + 0.15 * np.sin(x / width * 9) * np.cos(y / height * 7) + 0.2 * (x > 0.6 * width)
    return np.random.default_rng(seed).random((ticks, height, width)) < rate


def stream(spikes: np.ndarray, width: int | None = None, height: int | None = None) -> SpikeStream:
    return SpikeStream(pack(spikes), width or spikes.shape[2], height or spikes.shape[1], 2e4, source="x.dat")


def test_the_sizes_of_make_dataset_are_known() -> None:
    assert {(p.width, p.height) for p in PROFILES.values()} <= set(KNOWN_SIZES)


def test_the_length_and_the_rows_choose_among_known_sizes() -> None:
    data = pack(scene(400, 250, ticks=20)).reshape(-1)
    assert fitting_sizes(data) == [(400, 250), *sorted(fitting_sizes(data)[1:], key=lambda s: -row_agreement(data, s))]
    assert set(fitting_sizes(data)) == {(400, 250), (200, 125), (1000, 1000)}
    assert fitting_sizes(data[:-1]) == [] and fitting_sizes(data[:0]) == []


@pytest.mark.parametrize(("width", "height"), [(96, 60), (60, 96), (400, 250), (64, 40)])
def test_swapped_width_and_height_are_noticed(width: int, height: int) -> None:
    spikes = scene(width, height)
    assert size_doubt(stream(spikes)) is None
    doubt = size_doubt(stream(spikes, height, width))
    assert doubt is not None and doubt.startswith("x.dat: neighbouring rows") and "\n" not in doubt
    assert doubt.endswith(f"try --width {width} --height {height}")


def test_a_size_with_other_ticks_is_noticed() -> None:
    spikes = scene(400, 250)
    quarter = SpikeStream(pack(spikes).reshape(-1, 3125), 200, 125, 2e4)
    assert str(size_doubt(quarter)).endswith("try --width 400 --height 250")


@pytest.mark.parametrize("seed", range(5))
def test_noise_even_light_and_rows_that_differ_in_turn_raise_no_doubt(seed: int) -> None:
    rng = np.random.default_rng(seed)
    assert size_doubt(stream(rng.random((100, 60, 96)) < 0.3)) is None
    assert size_doubt(stream(np.zeros((100, 60, 96)))) is None
    rows = np.where(np.arange(60) % 2, 0.3, 0.4)[:, None] * np.ones((60, 96))
    assert size_doubt(stream(rng.random((100, 60, 96)) < rows)) is None
    assert size_doubt(stream(rng.random((100, 1, 96)) < 0.3)) is None


def test_rows_of_416_columns_are_noticed() -> None:
    """As many frames as make whole ticks of 400x250 too."""
    raw = np.concatenate([scene(400, 250, ticks=25), np.random.default_rng(1).random((25, 250, 16)) < 0.5], axis=2)
    assert str(size_doubt(SpikeStream(pack(raw).reshape(-1, 12_500), 400, 250, 2e4))).endswith(
        "try --width 416 --height 250"
    )


def test_a_real_recording_is_known_by_its_rows() -> None:
    data = np.fromfile(shared_file("data/real_spikes/car_100kmh_250x400_200f.dat"), np.uint8)
    assert fitting_sizes(data)[0] == (400, 250) and row_agreement(data, (400, 250)) > 0.99
    packed = data.reshape(200, -1)
    assert size_doubt(SpikeStream(packed, 400, 250, 4e4)) is None
    for wrong in ((250, 400), (500, 200), (200, 500), (800, 125)):
        assert str(size_doubt(SpikeStream(packed, *wrong, 4e4))).endswith("try --width 400 --height 250")
