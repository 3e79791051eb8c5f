"""`release check` finds what is wrong with a release."""

import shutil
import sys
from pathlib import Path

import pytest
from changes import flip_bit

from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.release import check
from spike4dgs.benchmark.release.check import find_problems


@pytest.fixture
def copy(release_folder: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(release_folder, tmp_path / "copy"))


def resum(root: Path) -> None:
    """Write SHA256SUMS anew, as somebody would who changes a file on purpose."""
    files = sorted(p for p in root.rglob("*") if p.is_file() and p.name != "SHA256SUMS")
    (root / "SHA256SUMS").write_text("".join(f"{sha256_file(p)}  {p.relative_to(root).as_posix()}\n" for p in files))


def test_a_flipped_bit_is_found(copy: Path) -> None:
    path = sorted(copy.glob("shards/*/*.tar"))[1]
    flip_bit(path, 100_000)
    assert [line for line in find_problems(copy) if path.name in line and "sha256" in line]


def test_a_missing_and_an_unknown_file_are_found(copy: Path) -> None:
    gone = sorted(copy.glob("shards/*/*.json"))[0]
    gone.unlink()
    (copy / "notes.txt").write_text("more")
    text = "\n".join(find_problems(copy))
    assert f"{gone}: missing" in text
    assert "not just the files that are there: notes.txt" in text


def test_the_limits_of_the_host(copy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert not list(find_problems(copy))
    for limit, value, words in (
        ("MOST_FILES", 5, "files, more than 5"),
        ("MOST_ENTRIES", 3, "entries, more than 3"),
        ("MOST_BYTES", 1_000_000, "bytes, more than 1000000"),
    ):
        with monkeypatch.context() as patch:
            patch.setattr(check, limit, value)
            assert [line for line in find_problems(copy) if words in line], limit
    (copy / "a b.txt").write_text("x")
    resum(copy)
    assert any("a b.txt: a name of other characters" in line for line in find_problems(copy))


@pytest.mark.parametrize(
    "text",
    [
        b"# No card\n",
        b"---\nlicense: [\n---\n",
        b"---\ntags: []\n---\n# No licence\n",
        b"---\nlicense: &a [mit]\ntags: [*a, *a]\n---\n",  # a few such lines stand for more than memory holds
        b"---\nlicense: \xff\n---\n",
    ],
)
def test_a_card_without_facts_is_found(text: bytes, copy: Path) -> None:
    (copy / "README.md").write_bytes(text)
    resum(copy)
    assert [line.split(": ")[0] for line in find_problems(copy)] == [str(copy / "README.md")]


def test_croissant_is_checked(copy: Path) -> None:
    mlcroissant = pytest.importorskip("mlcroissant")
    dataset = mlcroissant.Dataset(jsonld=str(copy / "croissant.json"))
    assert {r["scenes/id"] for r in dataset.records("scenes")} == {b"pattern-0", b"pattern-1"}
    path = copy / "croissant.json"
    path.write_text(path.read_text().replace('"sc:Dataset"', '"sc:Nothing"'))
    resum(copy)
    assert any("croissant.json: not valid" in line for line in find_problems(copy))


def test_what_is_not_validated_is_said(
    copy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "mlcroissant", None)
    assert not list(find_problems(copy))
    assert capsys.readouterr().out == "Croissant: not validated, needs `pip install mlcroissant`\n"


def test_an_index_that_lacks_a_file_is_found(copy: Path) -> None:
    path = sorted(copy.glob("shards/*/*.json"))[0]
    path.write_text(path.read_text().replace("cam_00.dat", "cam_09.dat"))
    resum(copy)
    text = "\n".join(find_problems(copy))
    assert "other hashes of" in text
    assert "pattern-0/spikes/cam_00.dat is not as its manifest lists it" in text
