"""A fit in a process that sees the training part alone: what it sees, what it makes, and how it ends."""

import fcntl
import io
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, cast

import dummy_methods
import pytest
from changes import edit_json, files_in
from dummy_methods import CountMethod, FailingMethod, WorkerKiller, prediction_bytes, run, wait_for, without_timings
from nosy_methods import DiesBesideItsChild, LacksWeights, LooksAround, PlaysBack, ReadsAndKeeps, Refines, Swaps
from rich.console import Console
from small_scenes import write_small_scene

from spike4dgs.benchmark import Budget, UserError, get_method, open_scene
from spike4dgs.benchmark.runs.apart.fit import Apart, _Child, _environment, _training_part, fit_apart
from spike4dgs.benchmark.runs.apart.messages import packed_method, unpacked_method
from spike4dgs.benchmark.runs.cell import Job
from spike4dgs.benchmark.runs.run import Settings, run_matrix
from spike4dgs.benchmark.scene.manifest import write_manifest

PSNR: dict[str, Any] = {"metrics": ("psnr",)}
APART: dict[str, Any] = {"apart": Apart(), **PSNR}
MADE = {"kind": "mitsuba", "world": "carousel", "variant": 7, "seed": 918273645, "versions": {"mitsuba": "3.98.7"}}


@pytest.fixture
def made_scene(small_scene: Path) -> Path:
    """A scene that says how it was made, with recordings of light and darkness for two cameras."""
    edit_json(small_scene / "scene.json", lambda meta: meta.update(source=MADE, title="A carousel"))
    write_manifest(small_scene)
    return small_scene


def cell_of(records: list[dict[str, Any]]) -> dict[str, Any]:
    (cell,) = records[0]["scenes"].values()
    return dict(cell)


def test_the_bits_are_those_of_a_fit_in_this_process(small_scene: Path, tmp_path: Path) -> None:
    method = get_method("tfp+static")
    here = run(tmp_path / "here", [small_scene], method, seed=3, budget=Budget(0.01), **PSNR)
    apart = run(tmp_path / "apart", [small_scene], method, seed=3, budget=Budget(0.01), **APART)
    assert cell_of(apart)["status"] == "ok"
    assert prediction_bytes(tmp_path / "apart") == prediction_bytes(tmp_path / "here")
    assert [without_timings(r) for r in apart] == [without_timings(r) for r in here]
    assert all((tmp_path / mode / "models/tfp+static/pattern-0.safetensors").is_file() for mode in ("here", "apart"))
    paths = [tmp_path / mode / "predictions/tfp+static/pattern-0/prediction.json" for mode in ("here", "apart")]
    info, other = (json.loads(path.read_text()) for path in paths)
    for key in ("key", "scene_revision", "split", "scene", "method", "budget"):
        assert info[key] == other[key], key
    assert other["fit_seconds"] > 0 and other["render_fps"] > 0 and other["peak_memory_mb"] > 10


def test_the_held_out_stream_is_not_next_to_the_others(small_scene: Path, tmp_path: Path) -> None:
    """Where workers fit apart too."""
    cell = cell_of(run(tmp_path / "here", [small_scene], PlaysBack(), **PSNR))
    assert cell["status"] == "ok" and cell["metrics"]["psnr"] > 25, "a method that looks for it in the scene finds it"
    cell = cell_of(run(tmp_path / "apart", [small_scene], PlaysBack(), workers=2, **APART))
    assert cell["status"] == "failed" and "not enough values to unpack" in cell["error"]
    assert not (tmp_path / "apart/predictions/plays-back/pattern-0").exists()


def test_what_a_fit_sees_has_neither_the_held_out_camera_nor_how_the_scene_was_made(
    made_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["spike4dgs", "run-benchmark", str(made_scene)])
    monkeypatch.setenv("SPIKE4DGS_RELEASE", str(tmp_path))
    monkeypatch.chdir(made_scene.parent)
    seen, scene = tmp_path / "seen.json", open_scene(made_scene)
    assert cell_of(run(tmp_path / "out", [made_scene], LooksAround(seen), **APART))["status"] == "ok"
    found = json.loads(seen.read_text())
    wanted = ["README.md", *(f"{name}.json" for name in ("croissant", "manifest", "scene", "targets"))]
    wanted += [f"sparse/0/{name}.bin" for name in ("cameras", "frames", "images", "points3D", "rigs")]
    wanted += [f"spikes/cam_0{i}.dat" for i in range(3)]
    assert found["files"] == sorted(wanted + [f"transforms_{name}.json" for name in ("all", "test", "train")])
    assert not found["links"], "symbolic links say where the scene lies"
    assert {found["names"][f"spikes/cam_0{i}.dat"] for i in range(3)} == {1}, "copies"
    text = json.dumps({key: found[key] for key in ("texts", "scene", "folder", "argv", "input")})
    for secret in ("carousel", "918273645", "3.98.7", "pattern-0", str(made_scene)):
        assert secret not in text, secret
    assert json.loads(found["texts"]["scene.json"])["source"] == {"kind": "mitsuba"}
    assert str(made_scene.parent) not in {found["environment"].get(name) for name in ("PWD", "SPIKE4DGS_RELEASE")}
    assert found["scene"][:2] == ["scene", scene.revision]
    exact = [[c.id, *c.K.ravel().tolist(), *c.R.ravel().tolist(), *c.t.tolist()] for c in scene.training.cameras]
    assert found["cameras"] == exact, "poses to the last bit"
    captured = capfd.readouterr()
    assert "printed to standard output" in captured.err and "printed" not in captured.out


def test_a_fit_reads_the_folders_that_the_callers_variables_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    variables = {
        "HOME": "/home/someone",
        "TORCH_HOME": "~/hub",
        "SPIKE4DGS_WEIGHTS": "weights",
        "NUMBA_CACHE_DIR": "kernels",
        "SPIKE4DGS_MITSUBA_VARIANT": "llvm_ad_rgb",
    }
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    found = _environment(tmp_path / "part")
    assert {name: found[name] for name in variables} == {
        **variables,
        "TORCH_HOME": "/home/someone/hub",
        "SPIKE4DGS_WEIGHTS": str(tmp_path / "weights"),
        "NUMBA_CACHE_DIR": str(tmp_path / "kernels"),
    }


@pytest.mark.parametrize("name", ["ZENODO_TOKEN", "HF_TOKEN", "SPIKE4DGS_UPLOAD_TOKEN"])
def test_a_fit_gets_no_token_of_its_caller(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(name, "secret")
    assert "secret" not in "".join(_environment(tmp_path).values())


def test_other_splits_hold_out_their_own_cameras(tmp_path: Path) -> None:
    """See also `test_training_part.py`."""
    scene, seen = write_small_scene(tmp_path / "scene", splits=True), tmp_path / "seen.json"
    with open(os.devnull, "w") as nothing:
        opened = open_scene(scene, split="corner")
        (record,) = run_matrix([opened], [LooksAround(seen)], Settings(tmp_path / "o", **APART), Console(file=nothing))
        (here,) = run_matrix([opened], [CountMethod()], Settings(tmp_path / "h", **PSNR), Console(file=nothing))
    assert record["mean"] == here["mean"] and record["dataset"]["split"] == "corner"
    streams = [name for name in json.loads(seen.read_text())["files"] if name.startswith("spikes/")]
    assert streams == [f"spikes/{camera}.dat" for camera in opened.train]


def test_refined_views_are_sent_after_the_images_are_taken(small_scene: Path, tmp_path: Path) -> None:
    plain, refined = run(tmp_path / "out", [small_scene], Refines(tmp_path / "seen.json"), seed=3, **APART)
    seen = json.loads((tmp_path / "seen.json").read_text())
    assert seen["before"] == 1 + 3 and seen["image"] > 0 and 0 < seen["background"] < 40 * 24
    assert [plain["method"]["name"], refined["method"]["name"]] == ["refines", "refines.refined"]
    here = run(tmp_path / "here", [small_scene], Refines(tmp_path / "here.json"), seed=3, **PSNR)
    assert [r["mean"] for r in here] == [plain["mean"], refined["mean"]] and plain["mean"] != refined["mean"]
    assert prediction_bytes(tmp_path / "out") == prediction_bytes(tmp_path / "here")
    assert json.loads((tmp_path / "here.json").read_text()) == seen
    model = json.loads((tmp_path / "out/models/refines/pattern-0.safetensors").read_text())
    assert model == {"scene": "pattern-0", "revision": open_scene(small_scene).revision}
    again = Refines(tmp_path / "again.json")
    run(tmp_path / "here", [small_scene], again, seed=3, **APART)
    assert again.fits == 0, "what a fit in this process made is kept"


def test_failures_come_back_as_from_this_process(small_scene: Path, tmp_path: Path) -> None:
    methods = FailingMethod("value", ValueError("no luck")), LacksWeights("weights")
    here = run(tmp_path / "here", [small_scene], *methods, **PSNR)
    apart = run(tmp_path / "apart", [small_scene], *methods, **APART)
    assert [r["scenes"] for r in apart] == [r["scenes"] for r in here]
    assert "ValueError: no luck" in (tmp_path / "apart/logs/value__pattern-0.log").read_text()
    assert not list((tmp_path / "apart").glob("work/*/part-*"))


GOOD = '["rendered", {"fit_seconds": 1, "render_fps": 1, "peak_memory_mb": 1, "model_mb": null}]'


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("not JSON", "expected a line of JSON from the fit's process"),
        ('["done", null]', "expected the line rendered, found ValueError: done"),
        ('["rendered", {"fit_seconds": -1}]', "expected numbers for fit_seconds, render_fps"),
        ('["rendered", {"fit_seconds": null}]', "expected numbers for fit_seconds"),
        ('["failed", {"status": "ok", "reason": "so", "traceback": ""}]', "so"),
        (GOOD, "expected an image of a target, found none"),
    ],
)
def test_a_process_that_lies_fails_its_cell(small_scene: Path, tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "said").write_text(line + "\n")
    liar = Apart(f"sh -c 'cat {tmp_path}/said; exec cat > {os.devnull}'")  # in the place of our program
    cell = cell_of(run(tmp_path / "out", [small_scene], CountMethod(), apart=liar, **PSNR))
    assert cell["status"] == "failed" and message in cell["error"]
    assert not (tmp_path / "out/predictions/counts/pattern-0").exists()


def test_progress_is_passed_on_and_a_link_in_the_place_of_an_image_is_refused(
    small_scene: Path, tmp_path: Path
) -> None:
    method, steps = Swaps(small_scene / "images/cam_03/000020.exr"), list[tuple[int, int, str]]()
    job = Job(method, open_scene(small_scene), 0, "cpu", Budget())
    with pytest.raises(UserError, match="expected an image of a target"):
        fit_apart(job, [tmp_path / "out"], tmp_path / "model", tmp_path / "work", lambda *a: steps.append(a), print)
    assert steps[-1] == (4, 4, "step 3") and not (tmp_path / "out").exists()


def test_a_process_that_is_killed_fails_its_cell_and_the_next_run_goes_on(small_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "bullet").touch()
    killer = WorkerKiller("killer", tmp_path)
    assert "its end by signal 9" in cell_of(run(tmp_path / "out", [small_scene], killer, **APART))["error"]
    console = Console(file=(text := io.StringIO()), width=200)
    again = run_matrix([open_scene(small_scene)], [killer], Settings(tmp_path / "out", **APART), console)
    assert cell_of(again)["status"] == "ok" and "resuming after" in text.getvalue(), "notes reach the caller"
    assert (tmp_path / "begins.txt").read_text().split() == ["0", "2"]
    run(tmp_path / "whole", [small_scene], CountMethod("killer"), **PSNR)
    same = "predictions/killer/pattern-0"
    assert prediction_bytes(tmp_path / "out" / same) == prediction_bytes(tmp_path / "whole" / same)


def test_a_process_that_dies_beside_its_own_child_holds_nobody(small_scene: Path, tmp_path: Path) -> None:
    child = tmp_path / "child"
    cell = cell_of(run(tmp_path / "out", [small_scene], DiesBesideItsChild(child), **APART))
    assert cell["status"] == "failed" and "its end by signal 9" in cell["error"]
    os.kill(int(child.read_text()), signal.SIGKILL)  # it still ran


def test_a_last_line_of_a_process_that_dies_while_one_looks_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    """Through a pipe of a number that `select` does not take."""
    monkeypatch.setattr("spike4dgs.benchmark.runs.apart.fit._POLL_S", 0.01)
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < 1100:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 1100), hard))
    low, write = os.pipe()  # open for writing to the end, as where the process has a child of its own
    read = fcntl.fcntl(low, fcntl.F_DUPFD, 1024)
    os.close(low)

    class Dying:
        """A process that says its last line after one has looked for it in vain, and before one asks for its end."""

        stdout, lines = open(read, "rb"), [b'["done", 3]\n']

        def poll(self) -> int:
            if self.lines:
                os.write(write, self.lines.pop())
            return 0

    with Dying.stdout:
        child = _Child(cast(Any, Dying()), "the process", lambda *_: None, print)
        assert child.wait("done") == 3 and not child._line()
    os.close(write)


def test_a_model_that_does_not_fit_on_its_own_disk_is_none(small_scene: Path, tmp_path: Path) -> None:
    """A part of it under its name would count as the model from then on."""
    other, work = Path("/dev/shm"), tmp_path / "work"
    if not other.is_dir() or other.stat().st_dev == tmp_path.stat().st_dev:
        pytest.skip("no second disk here")
    job = Job(CountMethod(), open_scene(small_scene), 0, "cpu", Budget())
    (tmp_path / "said").write_text(f'{GOOD}\n["done", null]\n')
    make = f"mkdir -p {work}/images-0/cam_03; echo > {work}/model.safetensors; cd {work}/images-0"
    for target in job.scene.targets:
        make += f"; echo > {target.name}.exr"
    fits = Apart(f"sh -c '{make}; cat {tmp_path}/said; exec cat > {os.devnull}'")  # in the place of our program
    with tempfile.TemporaryDirectory(dir=other) as folder:
        model = Path(folder, "model.safetensors")
        model.with_name(f".model.{os.getpid()}.part.safetensors").symlink_to("/dev/full")
        with pytest.raises(UserError, match="model.safetensors: expected room for the file"):
            fit_apart(job, [tmp_path / "out"], model, work, lambda *_: None, print, fits)
        assert not list(Path(folder).iterdir()) and not (tmp_path / "out").exists()
        fit_apart(job, [tmp_path / "out"], model, work, lambda *_: None, print, fits)
        assert model.is_file() and (tmp_path / "out").is_dir()


def caller(out: Path, scene: Path, folder: Path) -> subprocess.Popen[bytes]:
    """Start a run in a process group whose method waits in its fit."""
    code = (
        "import signal, sys; sys.path[:0] = sys.argv[4:]\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # a shell's background jobs ignore it
        "from pathlib import Path; from dummy_methods import WaitingMethod, run\n"
        "from spike4dgs.benchmark.runs.apart.fit import Apart\n"
        "out, scene, folder = map(Path, sys.argv[1:4])\n"
        "run(out, [scene], WaitingMethod('waits', folder), metrics=('psnr',), apart=Apart())\n"
    )
    support = str(Path(dummy_methods.__file__).parent)
    command = [sys.executable, "-c", code, str(out), str(scene), str(folder), support]
    process = subprocess.Popen(command, start_new_session=True, stderr=subprocess.PIPE)
    wait_for(lambda: (folder / "begun").exists() or process.poll() is not None)
    assert process.poll() is None
    return process


@pytest.mark.parametrize("how", ["kill", "interrupt"])
def test_the_process_ends_with_its_caller_and_removes_the_part(small_scene: Path, tmp_path: Path, how: str) -> None:
    process = caller(tmp_path / "out", small_scene, tmp_path)
    assert len(list(tmp_path.glob("out/work/*/part-*/scene.json"))) == 1
    if how == "kill":
        process.kill()
    else:
        os.killpg(process.pid, signal.SIGINT)
    assert process.wait(60) in (-signal.SIGKILL, 1, -signal.SIGINT)
    wait_for(lambda: not list(tmp_path.glob("out/work/*/part-*")))
    assert process.stderr is not None
    if how == "interrupt":
        text = process.stderr.read().decode()  # ends when no process holds the pipe
        assert text.count("KeyboardInterrupt") == 1, text
    process.stderr.close()


def test_a_fit_has_a_part_of_its_own_while_a_killed_fits_process_still_ends(small_scene: Path, tmp_path: Path) -> None:
    job, work = Job(CountMethod(), open_scene(small_scene), 0, "cpu", Budget()), tmp_path / "work"
    work.mkdir()
    with _training_part(job, work) as killed, _training_part(job, work) as again:
        assert not killed.exists(), "what killed fits left is removed"
        shutil.rmtree(killed, ignore_errors=True)  # what its process does at its end
        assert (again / "scene.json").is_file()
    assert files_in(work) == {}


def test_the_part_is_among_the_work_whatever_disk_that_is_on(small_scene: Path) -> None:
    """Beside the scene a method would find the held-out stream by `..`, and a killed fit would leave it there."""
    other = Path("/dev/shm")
    if not other.is_dir() or other.stat().st_dev == small_scene.stat().st_dev:
        pytest.skip("no second disk here")
    job = Job(CountMethod(), open_scene(small_scene), 0, "cpu", Budget())
    with tempfile.TemporaryDirectory(dir=other) as work, _training_part(job, Path(work)) as part:
        assert part.parent == Path(work) and (part / "spikes/cam_00.dat").stat().st_nlink == 1


def has_namespaces() -> bool:
    command = ["unshare", "--user", "--map-root-user", "--mount", "--pid", "--fork", "true"]
    return bool(shutil.which("unshare")) and subprocess.run(command, capture_output=True).returncode == 0


@pytest.mark.skipif(not has_namespaces(), reason="needs unshare and user namespaces")
def test_in_a_container_no_known_path_is_read_and_nothing_is_kept(
    small_scene: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """The command of the documentation: an empty folder lies over the scene's, and the work alone may be written to.

    But for /tmp, where this test's folders are.
    """
    stream, kept = small_scene / "spikes/cam_03.dat", tmp_path / "kept"
    unshare = "unshare --user --map-root-user --mount --net --pid --fork --kill-child --mount-proc"
    inside = """mount --bind "$1" "$1" && mount -o remount,bind,ro / && for d in "$0" /dev/shm; do
        mount -t tmpfs none "$d" || exit; done; shift; exec "$@" """
    fence = f"{unshare} sh -c '{inside}' {small_scene} {{work}}"
    cell = cell_of(run(tmp_path / "out", [small_scene], ReadsAndKeeps(stream, kept), apart=Apart(fence), **PSNR))
    assert cell["status"] == "ok" and stream.is_file(), "outside it is there"
    said = capfd.readouterr().err
    assert "read: No such file" in said and "kept: Read-only file system" in said and not kept.exists()


def test_a_method_of_a_package_travels_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """To pickle it runs its code in this process, which holds the truth."""
    method = get_method("tfp+static")
    monkeypatch.setattr(type(method), "__getstate__", lambda self: pytest.fail("pickled"), raising=False)
    assert packed_method(method) == "tfp+static"
    changed = get_method("tfp+static[trainer.fine_steps=7]")
    assert packed_method(changed) == changed.name and unpacked_method(changed.name).params == changed.params


def test_a_command_that_cannot_start_is_one_error(small_scene: Path, tmp_path: Path) -> None:
    for command, message in (("no-such-program x", "no-such-program"), ("'", "No closing quotation")):
        settings = {"apart": Apart(command), **PSNR}
        cell = cell_of(run(tmp_path / "out", [small_scene], CountMethod(), **settings))
        assert cell["status"] == "failed" and message in cell["error"] and "--container" in cell["error"]
