"""Key frames, dense and sparse."""

from __future__ import annotations

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import KeyStore
from spike4dgs.generators.rendering.render import StaticViews
from spike4dgs.generators.sensor.reference import tick_means

SHAPE = (2, 9, 13)
PLAN = KeyPlan(n_ticks=19, rate_hz=20_000, max_px=0.5, chain=(10, 5))


def sparse(given: np.ndarray, images: np.ndarray, kind: str = "") -> dict[str, np.ndarray]:
    """Return the arrays that the renderer gives for images [2, 9, 13]."""
    arrays = {}
    for v, (mask, image) in enumerate(zip(given, images, strict=True)):
        arrays |= {f"{kind}given{v}": np.packbits(mask), f"{kind}values{v}": image[mask]}
    return arrays


def make_images(seed=0, n=5):
    """Return static views, n random images, and which of their pixels are given at fine ticks."""
    rng = np.random.default_rng(seed)
    static = StaticViews(*rng.random((2, *SHAPE, 3), dtype=np.float32))
    images = np.repeat(gray(static.background)[None], n, 0)
    images[1:, :, 2:5, 3:7] = rng.random((n - 1, 2, 3, 4), dtype=np.float32)
    fast = np.zeros(SHAPE, bool)
    fast[:, 3, 4:6] = True
    return static, images, fast


@pytest.fixture
def store(tmp_path):
    static, images, fast = make_images()
    store = KeyStore(tmp_path / "keys")
    store.set_static(static)
    for tick, image in zip(PLAN.ticks, images, strict=True):
        store.put(tick, sparse(fast if PLAN.level(tick) else image != gray(static.background), image))
    return store


def test_coarse_keys_come_back_bit_for_bit(store):
    static, images, _ = make_images()
    again = KeyStore(store.folder)
    assert again.has_static and again.missing(PLAN) == []
    assert np.array_equal(again.static().background, static.background) and np.array_equal(
        again.static().first, static.first
    )
    for view in range(2):
        clip = again.view(view, PLAN)
        assert clip.ticks == [0, 5, 10, 15, 20] and len(clip.keys) == 5 and not clip.means
        for k in (0, 2, 4):
            assert np.array_equal(clip.keys[k], images[k, view]) and clip.keys[k].dtype == np.float32
        low, high = again.range(view, PLAN)
        assert np.array_equal(low, images[::2, view].min(0)) and np.array_equal(high, images[::2, view].max(0))


def test_between_coarse_keys_pixels_are_given_or_on_the_simulators_curve(store):
    _, images, fast = make_images()
    for view in range(2):
        clip = store.view(view, PLAN)
        for k in (1, 3):
            assert np.array_equal(clip.keys[k][fast[view]], images[k, view][fast[view]])
        # the mean of a tick of the twin's curve, on keys at 0, 10, 20 stretched so that a tick is very short
        coarse = images[::2, view].astype(np.float64)
        means = list(tick_means(coarse, [0, 10_001, 20_002], 20_002))
        for k, tick in ((1, 5_000), (3, 15_001)):
            np.testing.assert_allclose(clip.keys[k][~fast[view]], means[tick][~fast[view]], atol=2e-4)


def test_reading_in_any_order_gives_the_same(store):
    clip, other = store.view(0, PLAN), store.view(0, PLAN)
    ascending = [clip.keys[k] for k in range(5)]
    for k in (4, 1, 3, 0, 2, 1):
        assert np.array_equal(other.keys[k], ascending[k])


def test_means_are_those_of_the_curve_except_where_they_are_given(tmp_path):
    rng = np.random.default_rng(1)
    plan = KeyPlan(4, 20_000, 0.5, (1,), sub_ticks=2)
    store, images, means = (
        KeyStore(tmp_path),
        rng.random((5, *SHAPE), dtype=np.float32),
        rng.random((4, *SHAPE), dtype=np.float32),
    )
    fast = rng.random(SHAPE) < 0.3
    store.set_static(StaticViews(*np.repeat(images[0][None, ..., None], 2, 0).repeat(3, -1)))
    for tick in range(5):
        given = sparse(np.ones(SHAPE, bool), images[tick])
        store.put(tick, given | (sparse(fast, means[tick], "mean_") if tick < 4 else {}))
    clip = store.view(1, plan)
    assert clip.means and clip.ticks == [0, 1, 2, 3] and len(clip.keys) == 4
    for tick, curve in enumerate(tick_means(images[:, 1], range(5), 4)):
        assert np.array_equal(clip.keys[tick][fast[1]], means[tick, 1][fast[1]])
        np.testing.assert_allclose(clip.keys[tick][~fast[1]], curve[~fast[1]], atol=1e-6)


def test_only_given_pixels_are_stored(store):
    sizes = [(store.folder / f"{tick:06d}.npz").stat().st_size for tick in PLAN.ticks]
    assert sizes[0] < sizes[2] and sizes[1] < sizes[2]
    assert sizes[2] < 2 * 3 * 4 * 4 + 1300  # the rest is the file's own


def test_missing_keys_are_those_without_a_file(store):
    (store.folder / "000010.npz").unlink()
    (store.folder / ".000020.123.part.npz").write_bytes(b"half a key")
    assert store.missing(PLAN) == [10]


def test_equal_keys_give_equal_bytes(store, tmp_path):
    static, images, _ = make_images()
    other = KeyStore(tmp_path / "other")
    other.set_static(static)
    other.put(10, sparse(images[2] != gray(static.background), images[2]))
    for name in ("000010.npz", "still.npz"):
        assert (other.folder / name).read_bytes() == (store.folder / name).read_bytes()


def test_damage_and_bad_images_are_named(store):
    static, images, fast = make_images()
    with pytest.raises(UserError, match="000099.npz: expected arrays of a rendering, found no such file"):
        store.given(99, 0)
    path = store.folder / "000010.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0xFF
    path.write_bytes(data)
    with pytest.raises(UserError, match="000010.npz: expected arrays of a rendering, found damaged data"):
        store.given(10, 0), store.given(10, 1)
    path.write_bytes(data[:50])
    with pytest.raises(UserError, match="delete it and run"):
        store.given(10, 0)
    store.put(10, sparse(fast, images[0]) | {"values0": np.zeros(5, np.float32)})
    with pytest.raises(UserError, match="000010.npz: expected a key of"):
        store.given(10, 0)
    with pytest.raises(UserError, match="finite radiance"):
        store.put(20, sparse(fast, images[0] * np.float32(np.nan)))
    with pytest.raises(UserError, match="finite radiance"):
        store.set_static(StaticViews(static.background * np.float32(np.inf), static.first))
