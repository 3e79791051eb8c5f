"""Names that become files: what may be one, and paths that stay in their folder."""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.untrusted import check_ids, inside, is_id

HOSTILE = ["", ".", "..", "../x", "a/b", "/a", "a\\b", "-o", ".a", "a b", "a\n", "a\0", "ä", "C:a", "a+b", "a@b"]
HOSTILE += ["x" * 101]


@pytest.mark.parametrize("name", HOSTILE)
def test_names_that_are_no_ids(tmp_path: Path, name: str) -> None:
    assert not is_id(name)
    with pytest.raises(UserError, match="expected the id of a camera") as e:
        check_ids(["cam_00", name], "camera", tmp_path)
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("name", ["cam_00", "car-0-small", "views-3", "0", "x" * 100, "a..b", "car-0-paper-500ms-lens"])
def test_names_that_are_ids(name: str) -> None:
    check_ids([name], "scene", "here")


def test_ids_that_differ_in_case_alone_would_be_one_file_on_some_disks() -> None:
    check_ids(["cam_a", "cam_b", "cam_a"], "camera", "here")
    with pytest.raises(UserError, match="differ in more than case, found Cam_a and cam_a"):
        check_ids(["Cam_a", "cam_a"], "camera", "here")


@given(st.text(max_size=20))
def test_an_id_is_one_plain_component_of_a_path(name: str) -> None:
    if is_id(name):
        assert PurePosixPath("root", name).parts == ("root", name) and name.isascii() and name.isprintable()
        assert (Path("/root") / name).resolve() == Path("/root") / name


@given(st.text(alphabet="ab./\\:\0\n -", max_size=12))
def test_a_path_inside_a_folder_never_leaves_it(name: str) -> None:
    try:
        path = inside(Path("/root/folder"), name, "here")
    except UserError:
        return
    assert Path("/root/folder") in path.resolve().parents


@pytest.mark.parametrize("name", ["spikes/cam_00.dat", "a b.dat", "rotation (1).dat", "-x", "a..b/c.d"])
def test_usual_paths_are_taken(tmp_path: Path, name: str) -> None:
    assert inside(tmp_path, name, "here") == tmp_path / name
