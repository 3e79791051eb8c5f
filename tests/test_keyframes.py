"""The store of key frames: what goes in comes out, whole or not at all."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.generators.keyframes import KeyStore


def pictures(seed=0, n=4):
    """Background [2, 9, 13] and n keys that differ from it in a few pixels."""
    rng = np.random.default_rng(seed)
    still = rng.random((2, 9, 13), dtype=np.float32)
    keys = np.repeat(still[None], n, 0)
    for key in keys[1:]:
        key[:, 2:5, 3:7] = rng.random((2, 3, 4), dtype=np.float32)
    return still, keys


@pytest.fixture
def store(tmp_path):
    still, keys = pictures()
    store = KeyStore(tmp_path / "keys")
    store.set_background(still)
    for tick, key in zip((0, 5, 10, 15), keys, strict=True):
        store.write(tick, key)
    return store


def test_keys_come_back_bit_for_bit(store):
    still, keys = pictures()
    again = KeyStore(store.folder)
    assert again.has_background
    assert np.array_equal(again.background, still)
    for view in range(2):
        clip = again.view(view, [0, 5, 10, 15])
        assert len(clip) == 4
        assert all(np.array_equal(clip[k], keys[k, view]) and clip[k].dtype == np.float32 for k in range(4))
        low, high = again.range(view, [0, 5, 10, 15])
        assert np.array_equal(low, keys[:, view].min(0))
        assert np.array_equal(high, keys[:, view].max(0))


def test_only_changed_pixels_are_stored(store):
    assert (store.folder / "000000.npz").stat().st_size < (store.folder / "000005.npz").stat().st_size
    assert (store.folder / "000005.npz").stat().st_size < 2 * 3 * 4 * 8 + 1200


def test_missing_keys_are_those_without_a_file(store):
    (store.folder / "000010.npz").unlink()
    (store.folder / ".000020.123.part.npz").write_bytes(b"half a key")
    assert store.missing([0, 5, 10, 15, 20]) == [10, 20]


def test_equal_keys_give_equal_bytes(store, tmp_path):
    still, keys = pictures()
    other = KeyStore(tmp_path / "other")
    other.set_background(still)
    other.write(5, keys[1])
    assert (other.folder / "000005.npz").read_bytes() == (store.folder / "000005.npz").read_bytes()


def test_damage_and_bad_pictures_are_named(store):
    still, keys = pictures()
    with pytest.raises(UserError, match="000099.npz: expected a key frame, found no such file"):
        store.read(99, 0)
    path = store.folder / "000005.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(UserError, match="000005.npz: expected a key frame, found damaged data"):
        store.view(0, [5])[0], store.view(1, [5])[0]
    path.write_bytes(data[:50])
    with pytest.raises(UserError, match="delete it and run"):
        store.read(5, 0)
    with pytest.raises(UserError, match="render the same views"):
        store.write(20, keys[0][:1])
    with pytest.raises(UserError, match="finite radiance"):
        store.write(20, keys[0] * np.float32(np.nan))
    with pytest.raises(UserError, match="finite radiance"):
        store.set_background(still * np.float32(np.inf))
