"""Writing where it cannot be done: one line that says what to do, and nothing half written."""

import errno
import os
import resource
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import safetensors.numpy
from dummy_methods import CountMethod, run
from small_scenes import array_cameras

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import (
    atomic_path,
    check_file,
    check_writable,
    filling,
    locked,
    remove_parts,
    write_json,
    writing,
)
from spike4dgs.benchmark.scene.images import write_exr, write_mask
from spike4dgs.benchmark.scene.writer import write_colmap
from spike4dgs.benchmark.spikes.stream import SpikeWriter

BIG = np.random.default_rng(0).random((200, 300)).astype(np.float32)


def write_stream(path: Path) -> None:
    with SpikeWriter(path, 80, 10) as writer:
        for _ in range(3):
            writer.write(np.zeros((500, 100), np.uint8))


WRITERS: dict[str, Callable[[Path], None]] = {
    "a.json": lambda path: write_json(path, {"values": list(range(20000))}),
    "a.exr": lambda path: write_exr(path, BIG, 0.0),
    "a.png": lambda path: write_mask(path, BIG > 0.5),
    "a.dat": write_stream,
}
each_writer = pytest.mark.parametrize("name", WRITERS)


def part_of(path: Path) -> Path:
    """The temporary name that this process writes under."""
    stem, suffix = (path.name, "") if path.suffix == ".dat" else (path.stem, path.suffix)
    return path.with_name(f".{stem}.{os.getpid()}.part{suffix}")


def refused(path: Path, write: Callable[[Path], None], message: str) -> None:
    before = path.read_bytes() if path.is_file() else None
    with pytest.raises(UserError) as e:
        write(path)
    assert str(e.value).startswith(f"{path}: expected ") and message in str(e.value) and "\n" not in str(e.value)
    assert (path.read_bytes() if path.is_file() else None) == before
    assert not list(path.parent.glob(".*.part*")) if path.parent.is_dir() else True


@each_writer
def test_a_full_disk(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(b"old")
    part_of(path).symlink_to("/dev/full")  # a file on a full disk, as far as a program can tell
    refused(path, WRITERS[name], "o space left on device")


@contextmanager
def file_size_limit(size: int) -> Iterator[None]:
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, old[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)


@each_writer
def test_a_limit_that_is_met_in_the_middle_of_a_file(tmp_path: Path, name: str) -> None:
    with file_size_limit(4096):
        refused(tmp_path / name, WRITERS[name], "ile too large")
    WRITERS[name](tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == [name]


@each_writer
def test_a_file_instead_of_a_folder(tmp_path: Path, name: str) -> None:
    (tmp_path / "file").write_bytes(b"content")
    refused(tmp_path / "file" / name, WRITERS[name], "file exists; remove what is there instead")
    refused(tmp_path / "file/deeper" / name, WRITERS[name], "not a directory; remove what is there instead")
    assert (tmp_path / "file").read_bytes() == b"content"


@each_writer
def test_a_folder_instead_of_a_file(tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    refused(tmp_path / name, WRITERS[name], "is a directory; remove the folder of that name")


@contextmanager
def as_ordinary_user() -> Iterator[None]:
    """As one whom permissions stop: root may write anywhere."""
    user = os.geteuid()
    if user == 0:
        os.seteuid(65534)
    try:
        yield
    finally:
        os.seteuid(user)


@each_writer
def test_an_unwritable_folder(tmp_path: Path, name: str) -> None:
    def write(path: Path) -> None:
        with as_ordinary_user():
            WRITERS[name](path)

    WRITERS[name](tmp_path / name)  # with what it imports
    tmp_path.chmod(0o555)
    refused(tmp_path / name, write, "permission denied; change its permissions, or choose another folder")


@pytest.mark.parametrize(("code", "message"), [(errno.EROFS, "read-only file system"), (errno.EACCES, "permission")])
def test_what_the_system_says_is_passed_on(tmp_path: Path, code: int, message: str) -> None:
    with pytest.raises(UserError, match=message), writing(tmp_path / "a"):
        raise OSError(code, os.strerror(code))


def test_an_error_of_the_program_stays_one(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "a.json"):
        raise FileNotFoundError(errno.ENOENT, "no such file", "something-else")
    assert not list(tmp_path.iterdir())


def test_a_colmap_model_that_is_cut_off_is_noticed(tmp_path: Path) -> None:
    with file_size_limit(100), pytest.raises(UserError, match="sparse: expected .* free some disk space"):
        write_colmap(tmp_path / "sparse", array_cameras(), np.zeros((100, 3)))
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(UserError, match="file: expected folders on the way to the file, found file exists"):
        write_colmap(tmp_path / "file", array_cameras(), np.zeros((0, 3)))


@pytest.mark.parametrize("there", ["nothing", "a folder", "a link to a folder"])
def test_a_copy_that_fails_leaves_what_was_there(tmp_path: Path, there: str) -> None:
    out, target = tmp_path / "out", tmp_path / "target"
    target.mkdir()
    if there == "a folder":
        out.mkdir()
    elif there == "a link to a folder":
        out.symlink_to(target)
    before = sorted(p.name for p in tmp_path.iterdir())
    with pytest.raises(KeyboardInterrupt), filling(out):
        write_json(out / "deeper/a.json", {})
        write_json(out / "b.json", {})
        raise KeyboardInterrupt
    assert sorted(p.name for p in tmp_path.iterdir()) == before
    assert not list(target.iterdir()) and not (out.is_dir() and list(out.iterdir()))


def test_a_look_whether_one_may_write_makes_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    check_writable(tmp_path / "a/b")
    check_writable(tmp_path)
    check_file(tmp_path / "c/d/table.md")
    for wrong in (tmp_path / "file/out", tmp_path / "file", tmp_path / "a" / ("x" * 300)):
        with pytest.raises(UserError, match="^(?!.*part).*expected (folders on the way|a name that)"):
            check_writable(wrong)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_run_says_so_before_any_work(small_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    method = CountMethod()
    with pytest.raises(UserError, match="file/out: expected folders on the way"):
        run(tmp_path / "file/out", [small_scene], method)
    assert method.fits == 0


def test_a_killed_writer_leaves_no_file_under_the_final_name(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nimport numpy as np\n"
        "from spike4dgs.benchmark.spikes.stream import SpikeWriter\n"
        "with SpikeWriter(Path(sys.argv[1]), 8, 2) as w:\n"
        "    w.write(np.zeros((9, 2), np.uint8)); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, str(tmp_path / "a.dat")])
    assert all(p.name.startswith(".") for p in tmp_path.iterdir())


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o002, 0o664), (0o077, 0o600)])
def test_every_file_has_the_mode_that_the_umask_gives(tmp_path: Path, umask: int, mode: int) -> None:
    before = os.umask(umask)
    try:
        write_json(tmp_path / "a.json", {})
        with atomic_path(tmp_path / "a.safetensors") as part:
            safetensors.numpy.save_file({"x": BIG}, part)
    finally:
        os.umask(before)
    assert {p.name: p.stat().st_mode & 0o777 for p in tmp_path.iterdir()} == {"a.json": mode, "a.safetensors": mode}


def test_a_lock_that_is_a_link_leaves_its_target_alone(tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_text("content")
    (tmp_path / "x.lock").symlink_to(target)
    with pytest.raises(UserError, match="x.lock: expected a plain file, .* found a symbolic link; remove it"):
        with locked(tmp_path / "x.lock", "x", "free"):
            pass
    assert target.read_text() == "content"


def test_a_lock_that_is_a_fifo_is_an_error_and_no_wait(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "x.lock")
    with pytest.raises(UserError, match="x.lock: expected a plain file, .* found something else; remove it"):
        with locked(tmp_path / "x.lock", "x", "free"):
            pass


def test_parts_of_killed_processes_are_removed_and_nothing_else(tmp_path: Path) -> None:
    gone = [".a.123.part.json", ".a.9.part.json.mode", "deeper/.b.7.part", "deeper/.cam_00.dat.99.part"]
    kept = [".a.part", ".car.json", "a.123.part.json", ".lock", "deeper/cam_00.dat", ".parts/x.png"]
    kept += ["corner/.lock", "corner/.live.8.part.json", "corner/results/.live.8.part.json"]  # of another run
    for name in gone + kept:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    remove_parts(tmp_path)
    assert sorted(p.relative_to(tmp_path).as_posix() for p in tmp_path.rglob("*") if p.is_file()) == sorted(kept)


def test_parts_are_removed_beside_a_process_that_removes_folders(tmp_path: Path) -> None:
    done = threading.Event()

    def come_and_go() -> None:
        while not done.is_set():
            for name in "abcdefgh":
                (tmp_path / name / "inner").mkdir(parents=True)
            for name in "abcdefgh":
                shutil.rmtree(tmp_path / name)

    other = threading.Thread(target=come_and_go)
    other.start()
    try:
        for k in range(300):
            (tmp_path / f".a.{k}.part").touch()
            remove_parts(tmp_path)
            assert not (tmp_path / f".a.{k}.part").exists()
    finally:
        done.set()
        other.join()


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="a system without /proc")
def test_a_folder_that_cannot_be_made(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="/proc/spike4dgs/a.json: expected a folder that may be written to"):
        write_json(Path("/proc/spike4dgs/a.json"), {})
    with pytest.raises(UserError, match="/proc/spike4dgs: expected a folder that may be written to"):
        check_writable(Path("/proc/spike4dgs"))


def test_weights_on_a_full_disk(tmp_path: Path) -> None:
    def write(path: Path) -> None:
        with atomic_path(path) as part, file_size_limit(4096):
            safetensors.numpy.save_file({"a": BIG}, part)

    refused(tmp_path / "a.safetensors", write, "ile too large; free some disk space")
