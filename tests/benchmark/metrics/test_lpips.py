import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference_networks import published_networks

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.lpips import TRUNKS, empty_trunk, lpips, make_network
from spike4dgs.benchmark.weights import VARIABLE, WeightFile

NETS = ("alex", "vgg", "squeeze")


def make_image(seed: int, height: int = 48, width: int = 64) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@pytest.mark.parametrize("net", NETS)
def test_equals_the_published_package_on_its_random_trunks(net: str, published: dict[str, NDArray]) -> None:
    state = {k: torch.from_numpy(v) for k, v in published.items() if k.startswith(f"{net}/features.")}
    trunk = empty_trunk(net)
    trunk.load_state_dict({k.removeprefix(f"{net}/features."): v for k, v in state.items()})
    found = make_network(net, trunk).distance(published["a"], published["b"])
    assert found == pytest.approx(float(published[f"{net}/value"][0]), abs=1e-6)
    assert found > 1e-3, "the comparison means something"


@pytest.mark.parametrize("net", NETS)
def test_the_heads_are_those_of_the_published_package(net: str, published: dict[str, NDArray]) -> None:
    heads = make_network(net, empty_trunk(net)).weights
    assert len(heads) == sum(k.startswith(f"{net}/head.") for k in published)
    for i, head in enumerate(heads):
        np.testing.assert_array_equal(head.numpy(), published[f"{net}/head.{i}"])


@pytest.fixture(scope="module")
def published() -> dict[str, NDArray]:
    return published_networks()


def test_weights_come_from_the_users_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(4)
    trunk = empty_trunk("squeeze")
    state = {f"features.{k}": v for k, v in trunk.state_dict().items()} | {"classifier.1.weight": torch.zeros(2, 2)}
    path = tmp_path / "trunk.pth"
    torch.save(state, path)
    size, sha256 = path.stat().st_size, hashlib.sha256(path.read_bytes()).hexdigest()
    monkeypatch.setitem(TRUNKS, "squeeze", WeightFile(path.name, size, sha256, "a test", "nowhere"))
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    a, b = make_image(1), make_image(2)
    assert lpips("squeeze", a, b) == make_network("squeeze", trunk).distance(a, b)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        (make_image(0), make_image(0, 48, 65)),
        (make_image(0) / 255, make_image(0)),
        (make_image(0)[..., None], make_image(0)[..., None]),
        (make_image(0, 31, 64), make_image(0, 31, 64)),
    ],
)
def test_other_images_are_refused(a: NDArray, b: NDArray) -> None:
    network = make_network("squeeze", empty_trunk("squeeze"))
    with pytest.raises(UserError, match="LPIPS: expected two 8-bit gray images of one size, at least 32x32, found"):
        network.distance(a, b)


def test_the_smallest_image_suits_all_trunks() -> None:
    for net in NETS:
        assert make_network(net, empty_trunk(net)).distance(make_image(0, 32, 32), make_image(1, 32, 32)) > 0
