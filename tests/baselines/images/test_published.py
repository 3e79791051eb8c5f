"""Networks of other people: tensors, weights, what they return for known light, and images of a real recording."""

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import map_coordinates
from small_scenes import shared_file

from spike4dgs.baselines.images.published import makers, networks, scflow
from spike4dgs.baselines.images.published.makers import (
    FILES,
    MAKERS,
    SCFLOW,
    SPIKECLIP,
    SSIR,
    SSML,
    flow_at,
    load_network,
    thinned,
)
from spike4dgs.baselines.images.tfp import TFP
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.stream import SpikeStream, open_stream, pack
from spike4dgs.benchmark.weights import VARIABLE, FoundWeights, WeightsError

BY_NAME = {maker.name: maker for maker in MAKERS}


@pytest.fixture
def weights(monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of the authors' weights; the test is skipped where it is absent."""
    folder = shared_file(f"data/weights/{SSML.file.name}").parent
    monkeypatch.setenv(VARIABLE, str(folder))
    return folder


def regular(rate: float, ticks: int = 240, height: int = 24, width: int = 40) -> SpikeStream:
    """A stream of constant light: pixels fire regularly, each in its own phase."""
    phase = np.random.default_rng(0).random((height, width))
    fired = np.diff(np.floor(phase + rate * np.arange(ticks + 1)[:, None, None]), axis=0)
    return SpikeStream(pack(fired), width, height, 20_000.0)


def drifting(px_per_tick: float, ticks: int = 120, height: int = 64, width: int = 96) -> tuple[SpikeStream, np.ndarray]:
    """A smooth random texture that moves to the right, and its spikes per tick [ticks, H, W]."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:height, :width].astype(float)
    waves = [(rng.uniform(-0.5, 0.5, 2), rng.uniform(0, 6.28)) for _ in range(24)]
    rates = np.empty((ticks, height, width))
    for t in range(ticks):
        u = x - px_per_tick * t
        rates[t] = 0.2 + 0.03 * sum(np.sin(k[0] * u + k[1] * y + p) for k, p in waves)
    charge = np.cumsum(np.clip(rates, 0.01, 0.9), 0) + rng.random((height, width))
    return SpikeStream(pack(np.diff(np.floor(charge), axis=0, prepend=0)), width, height, 20_000.0), rates


@pytest.mark.parametrize(
    ("network", "tensors", "parameters"),  # with those of batch normalisation
    [
        (networks.Ssml, 17, 904_176),
        (networks.Ssir, 61, 382_767),
        (networks.SpikeClip, 10, 185_889),
        (scflow.ScFlow, 36, 803_320),
    ],
)
def test_a_network_has_as_many_tensors_and_parameters_as_its_authors_file(
    network: type[torch.nn.Module], tensors: int, parameters: int
) -> None:
    with torch.device("meta"):
        made = network()
    assert len(made.state_dict()) == tensors
    assert sum(t.numel() for t in made.state_dict().values()) == parameters


@pytest.mark.parametrize("size", [(24, 40), (25, 39), (5, 7)])
@pytest.mark.parametrize("network", [networks.Ssml, networks.Ssir, networks.SpikeClip])
def test_an_image_has_the_size_of_the_spikes(network: type[torch.nn.Module], size: tuple[int, int]) -> None:
    made = network().eval()
    with torch.inference_mode():
        assert made(torch.zeros(1, network.ticks, *size)).shape == (1, 1, *size)


def test_neurons_are_parametric_leaky_ones() -> None:
    """Fang et al., ICCV 2021: they charge, fire, and go back to rest where they fired."""
    neuron, inputs = networks._Neuron(), np.random.default_rng(0).normal(0.8, 1, (5, 3, 4, 6))
    with torch.no_grad():
        neuron.w.fill_(0.3)
        fired = neuron(torch.tensor(inputs)).numpy()
    potential, leak = np.zeros(inputs.shape[1:]), 1 / (1 + np.exp(-0.3))
    for x, found in zip(inputs, fired, strict=True):
        potential += leak * (x - potential)
        np.testing.assert_array_equal(found, potential >= 1)
        potential[potential >= 1] = 0
    assert 0.1 < fired.mean() < 0.5 and (fired[0] != fired[-1]).any()


def test_ssir_sees_the_windows_before_as_its_authors_sequences_do(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each pixel's thinned spikes are the same ones in every window."""
    seen: list[torch.Tensor] = []

    class Looks(networks.Ssir):
        def forward(self, spikes: torch.Tensor) -> torch.Tensor:
            seen.append(spikes)
            return super().forward(spikes)

    monkeypatch.setattr(makers, "load_network", lambda *_: Looks().eval())
    monkeypatch.setattr(makers, "find_weights", lambda _: FoundWeights(Path()))
    stream = regular(0.3)
    BY_NAME["ssir"](stream, [120], 1.0)
    kept = thinned(stream.window(40, 141), SSIR.keep_every)
    assert seen[0].shape == (4, 41, 24, 40)
    for spikes, first in zip(seen[0].numpy(), (0, 20, 40, 60), strict=True):
        np.testing.assert_array_equal(spikes, kept[first : first + 41])


def test_warping_and_correlating_are_those_of_scipy_and_of_loops() -> None:
    rng = np.random.default_rng(2)
    images, flow = rng.random((1, 3, 9, 11)), rng.normal(0, 3, (1, 2, 9, 11))
    y, x = np.mgrid[:9, :11]
    expected = [map_coordinates(i, (y + flow[0, 1], x + flow[0, 0]), order=1, mode="nearest") for i in images[0]]
    np.testing.assert_allclose(scflow.warp(torch.tensor(images), torch.tensor(flow))[0], expected, atol=1e-9)
    other = rng.random((1, 3, 9, 11))
    found = scflow.correlation(torch.tensor(images), torch.tensor(other)).numpy()
    for dy, dx, at in ((-4, -4, 0), (0, 0, 40), (1, -2, 47), (4, 4, 80)):
        for row, column in ((0, 0), (4, 5), (8, 10)):
            inside = 0 <= row + dy < 9 and 0 <= column + dx < 11
            product = images[0, :, row, column] @ other[0, :, row + dy, column + dx] / 3 if inside else 0.0
            assert found[0, at, row, column] == pytest.approx(product, abs=1e-12)


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_thinned_spikes_are_those_of_a_higher_threshold(keep_every: int, seed: int) -> None:
    spikes = (np.random.default_rng(seed).random((30, 3, 5)) < 0.4).astype(np.uint8)
    kept = thinned(spikes, keep_every)
    assert not (kept & ~spikes & 1).any()
    counts, of_kept = spikes.sum(0, dtype=int), kept.sum(0, dtype=int)
    assert ((of_kept == counts // keep_every) | (of_kept == -(-counts // keep_every))).all()
    for pixel in np.ndindex(3, 5):
        gaps = np.diff(np.flatnonzero(kept[(slice(None), *pixel)][spikes[(slice(None), *pixel)] > 0]))
        assert (gaps == keep_every).all()


@pytest.mark.parametrize(
    ("name", "rates", "tolerance"),
    [
        ("ssml", (0.2, 0.3, 0.5, 0.6), 0.2),
        ("ssir", (0.1, 0.2, 0.3, 0.5), 0.35),
        ("scflow-tfp", (0.05, 0.1, 0.3, 0.6), 0.02),
    ],
)
def test_constant_light_gives_its_rate(name: str, rates: tuple[float, ...], tolerance: float, weights: Path) -> None:
    images = [BY_NAME[name](regular(rate), [120], 1.0)[0] for rate in rates]
    for rate, image in zip(rates, images, strict=True):
        assert image.mean() == pytest.approx(rate, rel=tolerance)


def test_spikeclip_is_proportional_to_light(weights: Path) -> None:
    first, second = (float(BY_NAME["spikeclip"](regular(rate), [120], 1.0).mean()) for rate in (0.3, 0.6))
    assert second / first == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize("px_per_tick", [0.1, 0.3, -0.3])
def test_scflow_finds_a_drift_and_averages_along_it(px_per_tick: float, weights: Path) -> None:
    stream, rates = drifting(px_per_tick)
    network = load_network("scflow", SCFLOW, weights / SCFLOW.file.name, "cpu")
    windows = [torch.tensor(stream.window(t - 12, t + 13), dtype=torch.float32)[None] for t in (60, 70)]
    with torch.inference_mode():
        flow = network(*windows)[0, :, 8:-8, 8:-8].flatten(1).median(1).values
    assert flow[0] == pytest.approx(10 * px_per_tick, abs=0.5) and abs(flow[1]) < 0.5
    inner = (slice(12, -12), slice(16, -16))
    errors = [
        np.sqrt(np.mean((maker(stream, [60], 1.0)[0] - rates[60])[inner] ** 2))
        for maker in (BY_NAME["scflow-tfp"], TFP)
    ]
    assert errors[0] < (0.7 if abs(px_per_tick) > 0.2 else 1.1) * errors[1]


@pytest.mark.parametrize("tick", [0, 60, 109, 110, 119])
def test_flow_is_per_tick_to_the_ends_of_a_clip(tick: int) -> None:
    """The network is one that sees how far the only pixel that fires has come."""
    stream = SpikeStream(pack(np.eye(120, dtype=np.uint8)[:, None]), 120, 1, 20_000.0)

    def shift(first: torch.Tensor, second: torch.Tensor) -> torch.Tensor:
        here, there = (int(spikes[0, scflow.TICKS // 2, 0].argmax()) for spikes in (first, second))
        return torch.tensor([float(there - here), 0.0]).view(1, 2, 1, 1)

    assert flow_at(stream, tick, shift).flatten().tolist() == [1, 0]


@pytest.mark.parametrize("name", sorted(BY_NAME))
def test_the_real_recording_looks_right_and_a_wrong_bit_order_does_not(name: str, weights: Path) -> None:
    path = shared_file("data/real_spikes/car_100kmh_250x400_200f.dat")
    right = open_stream(path, 400, 250, 40_000.0)
    swapped = np.packbits(np.unpackbits(right.packed, axis=1, bitorder="big"), axis=1, bitorder="little")
    wrong = SpikeStream(swapped, 400, 250, 40_000.0)
    crop = (slice(96, 160), slice(80, 208))

    def image(stream: SpikeStream) -> np.ndarray:
        part = np.ascontiguousarray(stream.window(0, 200)[:, *crop])
        return np.asarray(BY_NAME[name](SpikeStream(pack(part), 128, 64, 40_000.0), [100], 1.0)[0])

    def variation(values: np.ndarray) -> float:
        """How much neighbours in a row differ, next to those in a column: 8 mirrored pixels raise it."""
        return float(np.abs(np.diff(values, axis=1)).mean() / np.abs(np.diff(values, axis=0)).mean())

    found = image(right)
    agreement = [np.corrcoef(found.ravel(), TFP(right, [t], 1.0)[0][crop].ravel())[0, 1] for t in (100, 25)]
    assert agreement[0] > 0.8 and agreement[0] > agreement[1], "the window is around the tick"
    assert variation(image(wrong)) > 1.03 * variation(found)


@pytest.mark.parametrize("published", [SSML, SSIR, SPIKECLIP, SCFLOW], ids=lambda p: p.file.name)
def test_other_bytes_are_refused_and_a_missing_file_is_a_reason(
    published: makers.Published, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))
    (name,) = (maker.name for maker in MAKERS if maker.name.partition("-")[0] == published_name(published))
    with pytest.raises(WeightsError, match="no such file") as missing:
        BY_NAME[name](regular(0.2), [120], 1.0)
    assert str(tmp_path) not in missing.value.reason
    assert BY_NAME[name].learned() is None
    torch.save({}, tmp_path / published.file.name)
    with pytest.raises(WeightsError, match="sha256"):
        BY_NAME[name](regular(0.2), [120], 1.0)


def published_name(published: makers.Published) -> str:
    return next(name for name, file in FILES.items() if file is published.file)


def test_a_file_of_other_tensors_is_refused(tmp_path: Path) -> None:
    torch.save({"enc1.conv1.conv.weight": torch.zeros(48, 40, 3, 3)}, tmp_path / "f.pth")
    with pytest.raises(UserError, match="other tensors, the first"):
        load_network("ssml", SSML, tmp_path / "f.pth", "cpu")
    torch.save({"module.x": 3}, tmp_path / "g.pth")
    with pytest.raises(UserError, match="found other values"):
        load_network("ssir", SSIR, tmp_path / "g.pth", "cpu")
    (tmp_path / "h.pth").write_bytes(b"not a file of torch")
    with pytest.raises(UserError, match="damaged data or another kind of file"):
        load_network("scflow", SCFLOW, tmp_path / "h.pth", "cpu")
