import hashlib
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from reference_networks import published_networks
from torch.nn import functional as F

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.metrics.iqa.metaiqa import metaiqa, metaiqa_network, predict
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.metrics.neural_trunks import ResNet18
from spike4dgs.benchmark.weights import METAIQA, VARIABLE, load_into

State = dict[str, torch.Tensor]
Weighed = tuple[torch.nn.Module, State]


def make_image(seed: int = 0, height: int = 60, width: int = 90) -> NDArray[np.uint8]:
    return np.random.default_rng(seed).integers(0, 256, (height, width), dtype=np.uint8)


@pytest.fixture(scope="module")
def weighed() -> Weighed:
    """The network with random weights, and these."""
    torch.manual_seed(1)
    network = metaiqa_network()
    state = network.state_dict()
    for name, tensor in state.items():
        if name.endswith("running_mean"):
            tensor.normal_(0, 0.1)
        elif name.endswith("running_var"):
            tensor.uniform_(0.5, 1.5)
    return load_into(network, {name: tensor.clone() for name, tensor in state.items()}, "x"), state


def test_resnet_equals_torchvisions() -> None:
    published = published_networks()
    state = {k.removeprefix("resnet/"): torch.from_numpy(v) for k, v in published.items() if k.startswith("resnet/")}
    expected = state.pop("value").numpy()
    network = load_into(ResNet18(), state, "torchvision")
    np.testing.assert_allclose(network(torch.from_numpy(published["x"])).numpy(), expected, atol=1e-5)
    assert np.ptp(expected) > 0.1


def plain_score(state: State, image: NDArray[np.uint8]) -> float:
    """The network written out over the state dict in float64, with OpenCV's resize for an image that is enlarged."""
    import cv2

    s = {k: v.double() for k, v in state.items()}
    large = cv2.resize(image / 255.0, (224, 224), interpolation=cv2.INTER_LINEAR)
    x = torch.tensor(np.stack([(large - m) / d for m, d in ((0.485, 0.229), (0.456, 0.224), (0.406, 0.225))])[None])

    def conv(x: torch.Tensor, name: str, bn: str, stride: int, padding: int) -> torch.Tensor:
        y = F.conv2d(x, s[f"resnet_layer.{name}.weight"], None, stride, padding)
        return norm(y, f"resnet_layer.{bn}")

    def norm(x: torch.Tensor, name: str) -> torch.Tensor:
        return F.batch_norm(x, *(s[f"{name}.{k}"] for k in ("running_mean", "running_var", "weight", "bias")))

    x = F.max_pool2d(F.relu(conv(x, "conv1", "bn1", 2, 3)), 3, 2, 1)
    for layer in (1, 2, 3, 4):
        for block in (0, 1):
            name, stride = f"layer{layer}.{block}", 2 if layer > 1 and block == 0 else 1
            y = F.relu(conv(x, f"{name}.conv1", f"{name}.bn1", stride, 1))
            y = conv(y, f"{name}.conv2", f"{name}.bn2", 1, 1)
            x = F.relu(y + (conv(x, f"{name}.downsample.0", f"{name}.downsample.1", 2, 0) if stride == 2 else x))
    x = F.linear(F.avg_pool2d(x, 7).flatten(1), s["resnet_layer.fc.weight"], s["resnet_layer.fc.bias"])
    for i in (1, 2):
        x = norm(F.linear(x, s[f"net.fc{i}.weight"], s[f"net.fc{i}.bias"]), f"net.bn{i}")
        x = F.prelu(x, s[f"net.relu{i}.weight"])
    return float(torch.sigmoid(F.linear(x, s["net.fc3.weight"], s["net.fc3.bias"])))


def test_equals_the_network_written_out_in_float64(weighed: Weighed) -> None:
    network, state = weighed
    image = make_image(1)
    assert predict(network, image) == pytest.approx(plain_score(state, image), abs=1e-4)


def test_the_head_has_the_published_size(weighed: Weighed) -> None:
    head = 1000 * 1024 + 1024 + 2 * 1024 + 1 + 1024 * 512 + 512 + 2 * 512 + 1 + 512 + 1
    assert sum(p.numel() for name, p in weighed[0].named_parameters() if name.startswith("net.")) == head


def test_weights_come_from_the_users_file_and_are_named_by_their_hash(
    weighed: Weighed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    network, state = weighed
    path = tmp_path / METAIQA.name
    torch.save(state, path)
    monkeypatch.setenv(VARIABLE, str(path))
    assert metaiqa(make_image()) == predict(network, make_image())
    assert select_metrics(("metaiqa",)).weights["metaiqa"] == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((60, 90), np.uint8), "expected an image of something, found one value everywhere"),
        (make_image() / 255, "expected an 8-bit gray image, found float64"),
        (make_image()[..., None], r"found uint8 \(60, 90, 1\)"),
    ],
)
def test_other_images_are_refused(weighed: Weighed, image: NDArray, message: str) -> None:
    with pytest.raises(UserError, match=message):
        predict(weighed[0], image)
