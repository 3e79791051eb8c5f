"""Choosing the device where PyTorch sees a GPU: faked, on machines with and without one."""

import json
import tomllib
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.baselines.recipes import PARTS
from spike4dgs.benchmark import Recipe, UserError, environment, find_methods, plugins
from spike4dgs.benchmark.environment import Missing, choose_device, missing_rasterizer
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.cli import main
from spike4dgs.method.fit import RecipeMethod


@pytest.fixture
def claims(monkeypatch: pytest.MonkeyPatch) -> None:
    """A PyTorch that claims a GPU, in an environment that has no numba-cuda."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    found = environment.find_spec
    monkeypatch.setattr(environment, "find_spec", lambda name: None if name == "numba_cuda" else found(name))
    environment._say_once.cache_clear()


@pytest.mark.usefixtures("claims", "no_images")
def test_a_gpu_without_kernels_means_the_cpu_and_one_line(
    small_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    steps = {"trainer.coarse_steps": 4, "trainer.fine_steps": 4, "images.time_spacing_ticks": 20}
    tiny = RecipeMethod(Recipe("tiny", "msdi", "rig", "static", "pixel", steps), PARTS)
    methods = {"tiny": tiny, "nearest-view": find_methods()["nearest-view"]}
    entry = SimpleNamespace(name="theirs", value="theirs:METHODS", dist=None, load=lambda: methods)
    monkeypatch.setattr(plugins, "entry_points", lambda group: [entry])
    command = ["run-benchmark", str(small_scene), "--methods", *methods, "--metrics", "psnr", "--in-process"]
    assert main([*command, "--out", str(out)]) == 0
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if not line.startswith("compiling")]  # whoever comes first
    assert len(lines) == 1, said
    line = lines[0]
    assert line.startswith("spike4dgs: computing on the CPU: PyTorch sees a CUDA device, but rendering on it needs")
    assert "pip install 'spike4dgs[cuda]'" in line and "--device cpu" in line
    for name in methods:
        cell = json.loads((out / f"results/{name}.json").read_text())["scenes"]["pattern-0"]
        assert cell["status"] == "ok" and cell["error"] is None
        prediction = json.loads((out / f"predictions/{name}/pattern-0/prediction.json").read_text())
        assert prediction["device"] == "cpu"


@pytest.mark.usefixtures("claims")
def test_asking_for_the_gpu_without_kernels_is_one_error_before_any_fit(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    arguments = ["run-benchmark", str(small_scene), "--methods", "tfp+static", "--device", "cuda", "--out", str(out)]
    assert main(arguments) == 2 and not out.exists()
    error = "error: --device cuda: expected the package numba-cuda, found none; pip install 'spike4dgs[cuda]'; or use "
    assert capsys.readouterr().err == f"{error}--device cpu\n"


@pytest.mark.usefixtures("claims")
def test_the_line_is_said_once_and_not_for_the_cpu(capsys: pytest.CaptureFixture[str]) -> None:
    assert choose_device("cpu") == "cpu" and not capsys.readouterr().err
    assert [choose_device("auto"), choose_device("auto")] == ["cpu", "cpu"]
    assert capsys.readouterr().err.count("\n") == 1


def test_networks_take_the_gpu_without_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    asked: list[str] = []
    missing = Missing("numba", "none", "install it")
    monkeypatch.setattr(environment, "missing_rasterizer", lambda *device: asked.extend(device) or missing)
    assert choose_device("auto", rasterizes=False) == "cuda"
    assert choose_device("cuda:0", rasterizes=False) == "cuda:0"
    with pytest.raises(UserError, match="--device cuda:0: expected numba, found none; install it; or use"):
        choose_device("cuda:0")
    assert asked == ["cuda:0"], "the trial is made on the device that is asked for"
    monkeypatch.setattr(environment, "missing_rasterizer", lambda *device: None)
    assert choose_device("auto") == "cuda" and choose_device("cuda") == "cuda"


@pytest.mark.parametrize("name", ["msdi", "spk2img"])
def test_image_makers_with_a_network_follow_the_fit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    stream = SpikeStream(pack(np.ones((50, 8, 8), np.uint8)), 8, 8, 20_000.0)
    on_cpu = IMAGES[name].on("cpu")
    assert on_cpu.name == name and on_cpu(stream, [25], 1.0).shape == (1, 8, 8)
    with pytest.raises(UserError, match="found 'cuda:7'"):
        IMAGES[name].on("cuda:7")(stream, [25], 1.0)
    assert IMAGES["tfp"].on("cuda:7") is IMAGES["tfp"]


def test_apples_gpu_falls_back_to_the_cpu_with_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    environment._say_once.cache_clear()
    assert [choose_device("mps"), choose_device("mps:0")] == ["cpu", "cpu"]
    assert capsys.readouterr().err.count("not on Apple's GPU") == 1


@pytest.fixture
def installed(monkeypatch: pytest.MonkeyPatch) -> None:
    """numba-cuda beside a PyTorch for CUDA 12.8, both for CUDA 12, and a trial that succeeds."""
    found = environment.find_spec
    monkeypatch.setattr(environment, "find_spec", lambda name: found("numba") if name == "numba_cuda" else found(name))
    monkeypatch.setattr(torch.version, "cuda", "12.8")
    monkeypatch.setattr(environment, "installed_version", {"cuda-bindings": "12.9.4"}.get)
    monkeypatch.setattr(environment, "trial", lambda device: "")


@pytest.mark.usefixtures("installed")
def test_each_part_that_rendering_needs_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert missing_rasterizer() is None
    monkeypatch.setattr(environment, "trial", lambda device: "CudaAPIError: the driver is too old")
    missing = missing_rasterizer()
    assert missing and missing.found == "CudaAPIError: the driver is too old"
    assert missing.fix == "pip install 'spike4dgs[cuda12]', or update the driver"
    monkeypatch.setattr(torch.version, "cuda", None)
    missing = missing_rasterizer()
    assert missing and missing.expected == "a PyTorch with CUDA" and "pytorch.org" in missing.fix
    monkeypatch.setattr(environment, "find_spec", lambda name: None)
    missing = missing_rasterizer()
    assert missing and missing.expected == "the package numba-cuda" and missing.fix == "pip install 'spike4dgs[cuda]'"


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("pytorch", "bindings", "fix"),
    [
        ("12.8", "13.1.0", "pip install 'spike4dgs[cuda12]'"),
        ("13.0", "12.9.4", "pip install 'spike4dgs[cuda]'"),
        ("11.8", "12.9.4", "install a PyTorch for CUDA 12 from pytorch.org"),
    ],
)
def test_two_cuda_versions_are_refused(pytorch: str, bindings: str, fix: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", pytorch)
    monkeypatch.setattr(environment, "installed_version", {"cuda-bindings": bindings}.get)
    missing = missing_rasterizer()
    assert missing and missing.fix == fix
    assert missing.expected == f"numba-cuda for CUDA {pytorch[:2]}, which PyTorch is for"
    assert missing.found == f"that for CUDA {bindings[:2]}"


@pytest.mark.parametrize(("cuda", "extra"), [("12.6", "cuda12"), ("13.0", "cuda"), (None, "cuda")])
def test_the_extra_is_that_of_pytorchs_cuda(cuda: str | None, extra: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.version, "cuda", cuda)
    assert environment.install_line() == f"pip install 'spike4dgs[{extra}]'"
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert extra in project["optional-dependencies"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_a_trial_without_a_device_fails_in_one_line() -> None:
    failure = environment.trial()
    assert failure and "\n" not in failure
