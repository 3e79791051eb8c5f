"""`download weights` from a local server, with stand-ins of the files."""

import hashlib
from pathlib import Path
from unittest.mock import Mock

import pytest
from range_server import Behaviour, serve

from spike4dgs.baselines.starts.dust3r import FILE as DUST3R
from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.release.source import Patience, Source
from spike4dgs.benchmark.release.transfer import PIECE
from spike4dgs.benchmark.release.weights import fetch_weights
from spike4dgs.benchmark.weights import ALEXNET, VARIABLE, NamedWeights, WeightFile, find_weights
from spike4dgs.cli import download_weights as command_module
from spike4dgs.cli.download_weights import FILES, download_weights

CONTENT = bytes(range(256)) * 4096 * 24  # 24 MiB: two pieces
DIGEST = hashlib.sha256(CONTENT).hexdigest()
FILE = WeightFile("w.pth", len(CONTENT), DIGEST, "a test", "https://example.org/w.pth", "MIT")
HASTE = Patience(first_wait_s=0.001, longest_wait_s=0.002)


@pytest.fixture(autouse=True)
def hub(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setitem(FILES, "lpips", FILE)
    monkeypatch.setitem(FILES, "dust3r", weight("dust3r.safetensors"))
    return tmp_path / "torch/hub/checkpoints"


@pytest.fixture
def server(tmp_path: Path) -> Path:
    root = tmp_path / "server"
    root.mkdir()
    (root / "w.pth").write_bytes(CONTENT)
    return root


def command(*names: str, **options: object) -> int:
    return download_weights(names, **options)


def weight(name: str) -> WeightFile:
    return WeightFile(name, None, None, "a test", f"hf://owner/name/{name}", "CC BY-NC-SA 4.0")


def test_weights_go_where_they_are_looked_for(server: Path, hub: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serve(server) as (address, seen):
        assert command("lpips", source=address, yes=True) == 0
        assert len(seen.requests) == 2
        assert find_weights(FILE).path == hub / "w.pth"
        assert (hub / "w.pth").read_bytes() == CONTENT
        assert command("lpips", source=address, yes=True) == 0
        assert len(seen.requests) == 2, "it is there"
    text = capsys.readouterr().out
    assert text.index("licence: MIT") < text.index(f"w.pth: sha256 {DIGEST}")


def test_licences_are_asked_for_first(
    server: Path, hub: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with serve(server) as (address, seen):
        with pytest.raises(UserError, match="licences: expected your consent .*; add --yes to accept them"):
            command("lpips", source=address)
        monkeypatch.setattr(command_module.sys.stdin, "isatty", lambda: True, raising=False)
        for answer in (Mock(return_value="no"), Mock(side_effect=EOFError)):  # the latter of Ctrl+D
            monkeypatch.setattr("builtins.input", answer)
            with pytest.raises(UserError, match="your consent"):
                command("lpips", source=address)
        assert not seen.requests and not hub.exists()
        monkeypatch.setattr("builtins.input", lambda prompt: "Y")
        assert command("lpips", source=address) == 0
    assert "licence: MIT" in capsys.readouterr().out


def test_a_wrong_file_is_refused(server: Path, hub: Path) -> None:
    (server / "w.pth").write_bytes(CONTENT[:-1] + b"x")
    with serve(server) as (address, _), pytest.raises(UserError, match=f"w.pth: expected sha256 {DIGEST}, found"):
        command("lpips", source=address, yes=True)
    assert not list(hub.glob("*.pth")) and not list(hub.glob(".*.part"))


def test_cuts_and_a_damaged_part_of_an_earlier_run(server: Path, hub: Path) -> None:
    hub.mkdir(parents=True)
    with serve(server, Behaviour(suffix=".pth", cuts=4, cut_after=100_000)) as (address, seen):
        (hub / ".w.pth.part").write_bytes(CONTENT[:PIECE])
        fetch_weights(Source(address, HASTE), "w.pth", FILE)
        assert {asked for _, asked in seen.requests} == {f"bytes={PIECE}-{len(CONTENT) - 1}"}, "it went on"
    assert (hub / "w.pth").read_bytes() == CONTENT
    (hub / "w.pth").unlink()
    (hub / ".w.pth.part").write_bytes(bytes(1000))
    with serve(server) as (address, _):
        fetch_weights(Source(address, HASTE), "w.pth", FILE)
    assert (hub / "w.pth").read_bytes() == CONTENT


def test_a_file_without_a_fixed_hash(server: Path, hub: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (server / "dust3r.safetensors").write_bytes(b"tensors")
    hub.mkdir(parents=True)
    (hub / ".dust3r.safetensors.part").write_bytes(b"other")  # of another source: no hash tells
    with serve(server) as (address, _):
        assert command("dust3r", source=address, yes=True) == 0
    assert hashlib.sha256(b"tensors").hexdigest() in capsys.readouterr().out
    named = NamedWeights("DUSt3R", "SPIKE4DGS_TEST_UNSET", "set it", download=weight("dust3r.safetensors"))
    assert find_weights(named).path == hub / "dust3r.safetensors"


def test_errors_are_one_line(server: Path) -> None:
    with pytest.raises(UserError, match="weights: expected one of lpips, lpips-vgg, .*, found 'vgg'"):
        command("vgg")
    with pytest.raises(UserError, match="weights metaiqa: expected an address of the file, found a page"):
        command("metaiqa", yes=True)
    with pytest.raises(UserError, match="http://127.0.0.1:1/w.pth: expected an answer"):
        fetch_weights(Source("http://127.0.0.1:1", HASTE), "w.pth", FILE)


def test_all_are_listed_without_a_name(capsys: pytest.CaptureFixture[str]) -> None:
    assert command() == 0
    text = capsys.readouterr().out
    assert all(name in text for name in ("lpips:", "lpips-vgg:", "metaiqa:", "dust3r:"))
    assert text.count("licence:") == 9


def test_each_file_names_the_command_that_fetches_it() -> None:
    known = {**FILES, "lpips": ALEXNET, "dust3r": DUST3R}
    expected = {name: f"download weights {name}" if file.address else "" for name, file in known.items()}
    assert {name: file.command for name, file in known.items()} == expected
    assert "run `spike4dgs download weights ssml`, or" in known["ssml"].fix and "state dict" in known["metaiqa"].fix


def test_the_known_addresses() -> None:
    assert ALEXNET.address == ("https://download.pytorch.org/models", "alexnet-owt-7be5be79.pth")
    assert FILES["metaiqa"].address is None
    assert DUST3R.address == ("hf://naver/DUSt3R_ViTLarge_BaseDecoder_512_dpt", "model.safetensors")
