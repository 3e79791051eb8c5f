"""The digest of sources changes with their text and names, and with nothing else."""

from pathlib import Path
from types import ModuleType

from spike4dgs.benchmark.runs.method_code import sources_sha256


def package(name: str, root: Path) -> ModuleType:
    made = ModuleType(name)
    made.__path__ = [str(root)]
    return made


def test_the_digest_is_of_names_and_texts_of_python_files(tmp_path: Path) -> None:
    def digest(*changes: tuple[str, str]) -> str:
        root = tmp_path / str(len(list(tmp_path.iterdir())))
        for name, text in dict((("a.py", "1"), ("inner/b.py", "2"), *changes)).items():
            (root / name).parent.mkdir(parents=True, exist_ok=True)
            (root / name).write_text(text)
        return sources_sha256([package("p", root)])

    same = digest()
    assert digest(("notes.md", "anything")) == same
    (tmp_path / "0/.#a.py").symlink_to("someone@machine.1:1")  # Emacs' lock of an unsaved file
    assert sources_sha256([package("p", tmp_path / "0")]) == same
    assert len({same, digest(("a.py", "3")), digest(("c.py", "")), digest(("inner/b.py", "3"))}) == 4
    root = tmp_path / "0"
    assert sources_sha256([package("q", root)]) != same
    assert sources_sha256([package("p", root), package("q", root)]) not in (same, sources_sha256([package("q", root)]))
