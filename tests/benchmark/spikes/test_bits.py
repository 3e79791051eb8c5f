"""Bit kernels against numpy's unpackbits, and one tick of the camera's model: the same compiled as in Python."""

from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.spikes import bits
from spike4dgs.benchmark.spikes.sensor_model import charge_after_spike, charge_of_tick


def reference(packed: np.ndarray, width: int, height: int, flip: bool) -> np.ndarray:
    plain = np.unpackbits(packed, axis=1, count=width * height, bitorder="little").reshape(-1, height, width)
    return plain[:, ::-1] if flip else plain


def random_rows(n: int, width: int, height: int, seed: int) -> np.ndarray:
    """Random bytes; the padding bits of the last byte are random too, and nobody may read them."""
    return np.random.default_rng(seed).integers(0, 256, (n, (width * height + 7) // 8), dtype=np.uint8)


def test_memory_maps_and_strided_rows(tmp_path: Path) -> None:
    packed = random_rows(30, 17, 5, 1)
    packed.tofile(tmp_path / "a.dat")
    mapped = np.memmap(tmp_path / "a.dat", np.uint8, "r", shape=packed.shape)
    np.testing.assert_array_equal(bits.unpack(mapped[3:20], 17, 5, True), reference(packed[3:20], 17, 5, True))
    np.testing.assert_array_equal(bits.count_bits(packed[::3], 85), bits.count_bits(packed[::3].copy(), 85))
    assert packed.flags.writeable  # the caller's array keeps its flags


@pytest.mark.parametrize("width", [400, 401])
def test_threads_change_no_bit(width: int, monkeypatch: pytest.MonkeyPatch) -> None:
    packed = random_rows(200, width, 250, 3)
    results = []
    for cores in ({0}, {0, 1}, {0, 1, 2, 3, 4}):
        monkeypatch.setattr(bits.os, "sched_getaffinity", lambda _, c=cores: c)
        results.append((bits.unpack(packed, width, 250, True), bits.count_bits(packed, width * 250)))
    for other in results[1:]:
        np.testing.assert_array_equal(results[0][0], other[0])
        np.testing.assert_array_equal(results[0][1], other[1])


def test_an_error_in_a_thread_is_raised() -> None:
    def fail(start: int, stop: int) -> None:
        raise ValueError(f"{start}")

    with pytest.raises(ValueError):
        bits.in_threads(fail, 10)


TICKS = [(0.3, 0.01, 1.0, 0.31), (-0.2, 0.01, 1.0, 0.0), (3.0, 0.01, 1.25, 1.25)]
SPIKES = [(1.2, 1.0, 1.2 - 1.0), (1.25, 1.25, 0.0), (2.5, 1.0, 1 - 2.0**-31)]


@pytest.mark.parametrize(("function", "cases"), [(charge_of_tick, TICKS), (charge_after_spike, SPIKES)])
def test_scalars_arrays_and_compiled_code_agree(function, cases):
    *arguments, expected = np.array(cases).T
    np.testing.assert_array_equal(function(*arguments), expected)
    assert [function(*row) for row in zip(*arguments, strict=True)] == expected.tolist()
    compiled = bits.kernel(function)
    assert [compiled(*row) for row in zip(*arguments, strict=True)] == expected.tolist()


@pytest.mark.parametrize(("width", "height"), [(16, 4), (13, 5), (8, 1), (1, 9), (400, 250)])
@pytest.mark.parametrize(("flip", "mirror"), [(False, False), (True, False), (False, True), (True, True)])
def test_orientation_equals_that_of_unpacked_images(width: int, height: int, flip: bool, mirror: bool) -> None:
    spikes = np.random.default_rng(0).random((2, height * width)) < 0.4
    packed = np.packbits(spikes, axis=1, bitorder="little")
    images = np.unpackbits(packed, axis=1, count=width * height, bitorder="little").reshape(-1, height, width)
    images = images[:, :: -1 if flip else 1, :: -1 if mirror else 1]
    expected = np.packbits(images.reshape(2, -1), axis=1, bitorder="little")
    np.testing.assert_array_equal(bits.orient(packed, width, height, flip, mirror), expected)
