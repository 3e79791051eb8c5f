import hashlib
import os
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from spike4dgs.benchmark import METRICS, UserError, weights
from spike4dgs.benchmark.metrics.measure import select_metrics
from spike4dgs.benchmark.metrics.neural_trunks import alexnet_features

CONTENT = b"weights"
SHA256 = hashlib.sha256(CONTENT).hexdigest()
FILE = weights.WeightFile("w.pth", len(CONTENT), SHA256, "a test", "https://example.org/w.pth")


@pytest.fixture(autouse=True)
def empty_hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No weights of this machine: torch hub's folder is an empty one."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(weights.VARIABLE, raising=False)
    folder = tmp_path / "torch/hub/checkpoints"
    folder.mkdir(parents=True)
    return folder


@pytest.mark.parametrize("variable", ["TORCH_HOME", "XDG_CACHE_HOME", None])
def test_the_hub_folder_is_torchs(variable: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("TORCH_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    if variable:
        monkeypatch.setenv(variable, str(tmp_path / "elsewhere"))
    assert weights.hub_folder() == Path(torch.hub.get_dir()) / "checkpoints"


def test_the_given_folder_goes_before_the_hub(empty_hub: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (empty_hub / "w.pth").write_bytes(CONTENT)
    assert weights.find_weights(FILE).path == empty_hub / "w.pth"
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path))
    assert weights.find_weights(FILE).path == empty_hub / "w.pth"
    (tmp_path / "w.pth").write_bytes(CONTENT)
    assert weights.find_weights(FILE).path == tmp_path / "w.pth"
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path / "w.pth"))
    found = weights.find_weights(FILE)
    assert (found.path, found.sha256) == (tmp_path / "w.pth", SHA256)


def test_an_absent_file_is_named_with_source(empty_hub: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(weights.VARIABLE, str(tmp_path / "mine"))
    with pytest.raises(weights.WeightsError) as e:
        weights.find_weights(file := weights.ALEXNET)
    text = str(e.value)
    told = (file.name, "244408911 bytes", str(file.sha256), file.source, weights.VARIABLE, empty_hub, tmp_path / "mine")
    assert all(str(part) in text for part in told) and "\n" not in text
    assert file.name in e.value.reason and str(tmp_path) not in e.value.reason


def test_another_file_of_the_name_is_refused_and_hashed_anew_after_a_change(empty_hub: Path) -> None:
    path = empty_hub / "w.pth"
    path.write_bytes(b"Weights")
    with pytest.raises(weights.WeightsError, match=rf"w\.pth: expected .*{SHA256}.*found 7 bytes .* (?!{SHA256})"):
        weights.find_weights(FILE)
    path.write_bytes(CONTENT)
    os.utime(path, ns=(1, 1))
    assert weights.find_weights(FILE).sha256 == SHA256


def test_the_shipped_file_never_takes_the_place_of_a_named_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OF_A_TEST", raising=False)
    bare = weights.NamedWeights("weights of a test", "OF_A_TEST", "train them")
    with pytest.raises(weights.WeightsError, match="expected weights of a test, found OF_A_TEST not set; train") as e:
        weights.find_weights(bare)
    assert e.value.reason == "needs weights of a test: train them"
    shipped, mine = tmp_path / "shipped.safetensors", tmp_path / "mine.bin"
    kind = replace(bare, shipped=shipped)
    with pytest.raises(weights.WeightsError, match=r"shipped\.safetensors: expected weights of a test, found no such"):
        weights.find_weights(kind)
    shipped.write_bytes(CONTENT)
    found = weights.find_weights(kind)
    assert (found.path, found.sha256) == (shipped, SHA256)
    monkeypatch.setenv("OF_A_TEST", str(mine))
    with pytest.raises(weights.WeightsError, match=r"mine\.bin: expected weights of a test, found no such file") as e:
        weights.find_weights(kind)
    assert str(tmp_path) not in e.value.reason
    mine.touch()
    assert weights.find_weights(kind).path == weights.find_weights(bare).path == mine


def test_headers_and_tensors_of_safetensors(tmp_path: Path) -> None:
    path = tmp_path / "s.bin"
    save_file({"a": torch.arange(3.0)}, path, metadata={"card": "text"})
    assert weights.read_header(path, "card", "weights", "train them") == "text"
    assert torch.equal(weights.read_tensors(path, "weights", "train them")["a"], torch.arange(3.0))
    with pytest.raises(UserError, match=r"s\.bin: expected metadata other, found card; train them"):
        weights.read_header(path, "other", "weights", "train them")
    path.write_bytes(b"\x80\x02pickle")
    for damaged in (path, tmp_path / "absent.safetensors"):
        for read in (weights.read_tensors, lambda path, *told: weights.read_header(path, "card", *told)):
            with pytest.raises(UserError, match=rf"{damaged.name}: expected weights, found damaged data or another"):
                read(damaged, "weights", "train them")


def test_the_names_of_torch_hubs_files_hold_the_start_of_their_hashes() -> None:
    for file in (weights.ALEXNET, weights.VGG16, weights.SQUEEZENET):
        found = re.search(r"-([0-9a-f]{8})\.pth$", file.name)
        assert found and file.sha256 and file.sha256.startswith(found[1]) and len(file.sha256) == 64


def test_auto_leaves_out_metrics_without_weights_and_gives_the_reason() -> None:
    selection = select_metrics()
    assert set(selection.absent) == {"lpips_alex", "lpips_vgg", "lpips_squeeze", "metaiqa"}
    assert all(m.weights is None for m in selection.metrics) and set(selection.weights.values()) == {None}
    assert set(selection.weights) | set(selection.absent) == set(METRICS)
    assert "needs the file vgg16-397923af.pth" in selection.absent["lpips_vgg"]


def test_a_requested_metric_needs_its_weights(empty_hub: Path) -> None:
    with pytest.raises(UserError, match=r"vgg16-397923af\.pth: expected .* 553433881 bytes"):
        select_metrics(("auto", "lpips_vgg"))
    (empty_hub / weights.METAIQA.name).write_bytes(CONTENT)
    selection = select_metrics(("metaiqa",))
    assert selection.weights["metaiqa"] == SHA256
    assert selection.weights["psnr"] is None and selection.absent["flip"] == "not asked for"
    with pytest.raises(UserError, match="--metrics: expected a name that docs/metrics.md lists.*, found 'vmaf'"):
        select_metrics(("auto", "vmaf"))


def test_a_selection_can_be_narrowed() -> None:
    selection = select_metrics().among(["psnr", "flip", "lpips_alex"])
    assert [m.id for m in selection.metrics] == ["psnr", "flip"]
    assert set(selection.weights) | set(selection.absent) == set(METRICS)


def test_state_dicts_are_read_from_both_kinds_of_file(tmp_path: Path) -> None:
    state = {"a": torch.arange(3.0)}
    torch.save(state, tmp_path / "s.pth")
    torch.save(state, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    save_file(state, tmp_path / "s.safetensors")
    for name in ("s.pth", "old.pth", "s.safetensors"):
        assert torch.equal(weights.read_state(tmp_path / name)["a"], state["a"])


class Surprise:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, ("surprise",)


def test_files_without_tensors_are_refused_and_run_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    torch.save(Surprise(), tmp_path / "code.pth")
    torch.save([torch.zeros(1)], tmp_path / "list.pth")
    torch.save({"epoch": 3}, tmp_path / "epoch.pth")
    (tmp_path / "cut.pth").write_bytes(b"PK\x03\x04 and no more")
    (tmp_path / "cut.safetensors").write_bytes(b"no header")
    (tmp_path / "empty.pth").touch()
    for path in tmp_path.glob("*.*"):
        with pytest.raises(UserError, match=rf"{path.name}: expected a (file of|mapping from names to) tensors"):
            weights.read_state(path)
    assert not (tmp_path / "surprise").exists()


def test_only_the_networks_own_tensors_are_taken() -> None:
    network = alexnet_features()
    state = dict(network.state_dict())
    loaded = weights.load_into(alexnet_features(), state, "f")
    assert not any(p.requires_grad for p in loaded.parameters()) and not loaded.training
    with torch.device("meta"):
        bare = alexnet_features()
    for name, tensor in weights.load_into(bare, {k: v.half() for k, v in state.items()}, "f").state_dict().items():
        assert torch.equal(tensor, state[name].half().float())
    with pytest.raises(UserError, match=r"f: expected the 10 tensors of the network, found 1 other .*0\.bias missing"):
        weights.load_into(network, {k: v for k, v in state.items() if k != "0.bias"}, "f")
    with pytest.raises(UserError, match=r"the first extra \(1,\); give the file that belongs to this network"):
        weights.load_into(network, {**state, "extra": torch.zeros(1)}, "f")
    with pytest.raises(UserError, match=r"the first 0\.bias \(63,\)"):
        weights.load_into(network, {**state, "0.bias": torch.zeros(63)}, "f")
