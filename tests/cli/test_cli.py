import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from changes import edit_json, flip_bit
from dummy_methods import CountMethod, run
from small_scenes import write_small_scene

from spike4dgs.benchmark.runs.record import read_record
from spike4dgs.cli import COMMANDS, Command, main
from spike4dgs.cli import dispatch as cli
from spike4dgs.cli.commands import GROUPS
from spike4dgs.cli.dispatch import load

HEAVY = ("torch", "numba", "mitsuba", "skimage", "cv2", "scipy", "matplotlib", "numpy", "tyro", "rich")


def python(*arguments: str, cwd: Path | None = None, **environment: str) -> subprocess.CompletedProcess[str]:
    given = {**os.environ, **environment}
    return subprocess.run([sys.executable, *arguments], capture_output=True, text=True, cwd=cwd, env=given)


def test_help_imports_nothing_heavy() -> None:
    loaded = f"[m for m in {HEAVY!r} if m in sys.modules]"
    code = f"import sys; from spike4dgs.cli import main; print(main(['--help']), {loaded}, file=sys.stderr)"
    done = python("-c", code)
    assert done.stderr == "0 []\n"
    for name in COMMANDS:
        assert f"  {name} " in done.stdout


def test_every_command_has_one_heading_in_help() -> None:
    words = " ".join(GROUPS.values()).split()
    assert sorted(words) == sorted({name.partition(" ")[0] for name in COMMANDS})


@pytest.mark.parametrize("columns", [80, 100, 200])
def test_help_fits_terminals(columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= columns
    assert [heading for heading in GROUPS if f"\n\n{heading}:\n" in text] == list(GROUPS)
    assert text.count("\n  report ") == sum(name.startswith("report ") for name in COMMANDS)
    assert " ".join(COMMANDS["import-dat"].summary.split()) in " ".join(text.split())


def test_no_arguments_and_help_say_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert main([]) == 0 and capsys.readouterr().out == text
    assert main(["-h"]) == 0 and capsys.readouterr().out == text


def test_a_command_of_two_words_is_found_by_both(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["release"]) == main(["release", "--help"]) == 0
    text = capsys.readouterr().out
    assert "usage: spike4dgs release COMMAND" in text and "  pack " in text and "  check " in text
    assert main(["release", "chekc"]) == 2
    assert "did you mean 'check'?" in capsys.readouterr().err
    assert main(["release", "check", str(tmp_path)]) == 2
    assert "release.json: expected the description of a release" in capsys.readouterr().err
    assert main(["download", "weights", "nothing"]) == 2
    assert "weights: expected one of lpips" in capsys.readouterr().err


def test_the_version_is_the_packages(capsys: pytest.CaptureFixture[str]) -> None:
    from importlib.metadata import version

    assert main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == version("spike4dgs")


@pytest.mark.parametrize(
    ("track", "made"),
    [
        ("ideal", "--track ideal"),
        ("uncalibrated", "--track ideal"),
        ("quick-start", "car turntable --profile small"),
    ],
)
def test_a_track_whose_scenes_are_not_here_says_what_makes_them(track: str, made: str, capsys, monkeypatch) -> None:
    monkeypatch.delenv("SPIKE4DGS_RELEASE", raising=False)
    assert main(["run-benchmark", "--track", track, "--data", "no where"]) == 2
    assert f"or render with `spike4dgs make-dataset {made} --out 'no where'`" in capsys.readouterr().err


@pytest.mark.parametrize(
    "command", ["render no", "view no", "export-ply no --out o", "speed render no", "patterns no --out o"]
)
def test_commands_of_models_take_the_device_as_fit_does(command: str, capsys, monkeypatch) -> None:
    monkeypatch.setattr("spike4dgs.cli.view.need_viser", lambda: None)
    assert main([*command.split(), "--device", "x"]) == 2
    assert "--device: expected auto, cpu or cuda, found 'x'; choose one of them\n" in capsys.readouterr().err
    assert main([*command.split(), "--device", "auto"]) == 2
    assert "error: no: expected a " in capsys.readouterr().err


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_help_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*name.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert f"usage: spike4dgs {name}" in text
    assert "\n        " not in (load(name).__doc__ or "").partition("Args:\n")[2], "an entry's lines would break twice"
    assert f"Example:\n  spike4dgs {name}" in text.replace("│", "")
    assert f"{COMMANDS[name].example} ".startswith(f"{name} ") and COMMANDS[name].target.startswith("spike4dgs.cli.")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["scroe"], "error: spike4dgs: expected a name that `spike4dgs --help` lists, such as score"),
        (["scroe"], "found 'scroe'; did you mean 'score'?"),
        (["zzz"], "expected a name that `spike4dgs --help` lists, found 'zzz'; correct the name"),
        (["speed", "rendr"], "did you mean 'render'?"),
        (["score", "nowhere", "also-nowhere"], "also-nowhere: expected a scene folder, found no such folder"),
        (["submit", "nothing.json"], "nothing.json: expected a spike4dgs-result/1 record, found no such file"),
        (["verify", "nowhere"], "nowhere: expected a scene folder"),
        (
            ["verify-leaderboard", "nowhere"],
            "nowhere: expected a leaderboard, found no such folder; run this in a checkout",
        ),
        (
            ["season", "check", "0", "--seasons", "nowhere"],
            "nowhere/0/season.json: expected a season, found no such file; ",
        ),
        (["verify"], "scenes: expected at least one scene folder"),
        (["submit", "result.json", "--container", "env"], "--container: expected --refit beside it, found none"),
        # The command lines that `season check` prints after the reveal have seeds of 128 bits.
        (["make-dataset", "moon", "--seed", str(2**128 - 1)], "world: expected one of "),
        (["speed", "images", "--repeats", "0"], "--repeats: expected 1 or more, found"),
        (["speed", "render", "model.safetensors", "--times", "0"], "--times: expected 1 or more, found"),
        (["speed", "record", "--cameras", "0"], "--cameras: expected 1 or more, found"),
        (["report", "dark-poses", ".", "--bursts", "0"], "--bursts: expected 1 or more, found"),
        (["report", "dark-points", ".", "--bursts", "-1"], "--bursts: expected 1 or more, found"),
    ],
)
def test_bad_input_is_a_line_and_exit_2(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert shown.out == "" and shown.err.count("\n") == 1
    assert shown.err.startswith("error: ") and message in shown.err


@pytest.mark.parametrize(
    "arguments",
    [
        ["score"],
        ["score", "a", "b", "--nonsense"],
        ["run-benchmark", "a", "--seed", "red"],
        ["submit", "r.json", "--replace", "maybe"],
    ],
)
def test_bad_arguments_are_tyros_message_and_exit_2(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    shown = capsys.readouterr()
    assert "spike4dgs" in shown.err and "--help" in shown.err and "Traceback" not in shown.err


def interrupted() -> int:
    """Be interrupted."""
    raise KeyboardInterrupt


def test_an_interruption_is_exit_130(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(cli, "COMMANDS", {"wait": Command(f"{__name__}:interrupted", "wait", "wait")})
    assert main(["wait"]) == 130
    assert capsys.readouterr().err == "interrupted\n"


# A command that prints as the others do, and imports no method.
SHOWS = """
import sys
from spike4dgs.benchmark.reports.console import make_console
from spike4dgs.cli import Command, dispatch, main

def show() -> int:
    "Show."
    make_console().print("shown")
    return 0

dispatch.COMMANDS = {"show": Command("__main__:show", "show", "show")}
sys.exit(main(["show"]))
"""


@pytest.mark.parametrize("program", [["-m", "spike4dgs.cli", "--help"], ["-c", SHOWS]], ids=["print", "console"])
def test_a_reader_that_goes_away_is_no_traceback(program: list[str]) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed:
        done = subprocess.run([sys.executable, *program], stdout=closed, stderr=subprocess.PIPE, text=True)
    assert done.returncode in (1, 141) and not done.stderr  # 1 where rich notices first


def test_score_prints_a_line_for_each_scene_and_writes_a_record(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    expected = run(tmp_path / "out", [small_scene], CountMethod())[0]
    predictions = str(tmp_path / "out/predictions/counts/pattern-0")
    capsys.readouterr()
    assert main(["score", predictions, str(small_scene), "--out", str(tmp_path / "r.json")]) == 0
    line, written = capsys.readouterr().out.splitlines()
    assert line.startswith(f"counts on pattern-0: psnr {expected['mean']['psnr']:.2f}, ssim ") and "fit " in line
    assert written.endswith("r.json")
    assert read_record(tmp_path / "r.json")["scenes"] == expected["scenes"]


def test_a_folder_in_place_of_a_file_is_said_before_the_work(
    small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["score", str(tmp_path / "none"), str(small_scene)], ["worlds", "car"]):
        assert main([*arguments, "--out", str(tmp_path)]) == 2
        assert capsys.readouterr().err.startswith("error: --out: expected the name of a file, found the folder")


@pytest.mark.parametrize(
    "arguments",
    [
        ["score", "none", "none", "--out", "new/r.json"],
        ["worlds", "moon", "--out", "new/w.md"],
        ["calibrate-rig", "none", "--out", "new/rig"],
        ["run-benchmark", "none", "--out", "new/out", "--leaderboard", "new/board"],
    ],
)
def test_a_mistyped_name_makes_no_folder(arguments: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    assert not list(tmp_path.iterdir())


def test_a_name_that_the_outputs_encoding_lacks_is_escaped(small_scene: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(small_scene, tmp_path / "\u6570\u636e")
    done = python("-m", "spike4dgs.cli", "verify", str(folder), PYTHONIOENCODING="cp1252")
    assert done.returncode == 0 and "\\u6570\\u636e: " in done.stdout and not done.stderr


def test_score_refuses_other_images(small_scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(tmp_path / "out", [small_scene], CountMethod())
    folder = tmp_path / "out/predictions/counts/pattern-0"
    other = write_small_scene(tmp_path / "other", seed=1)
    assert main(["score", str(folder), str(other)]) == 2
    assert "expected predictions for scene pattern-1, found pattern-0" in capsys.readouterr().err
    edit_json(folder / "prediction.json", lambda info: info.update(scene_revision="0" * 64))
    assert main(["score", str(folder), str(small_scene)]) == 2
    assert "expected predictions for scene revision" in capsys.readouterr().err
    assert main(["score", str(folder), str(small_scene), str(other)]) == 2
    assert "expected predictions for 2 scenes, found predictions for one" in capsys.readouterr().err


def test_verify_names_every_damaged_file(small_scene: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["verify", str(small_scene)]) == 0
    assert "files, revision" in capsys.readouterr().out
    for name in ("spikes/cam_00.dat", "images/cam_03/000020.exr"):
        flip_bit(small_scene / name, 9)
    (small_scene / "sparse/0/images.bin").unlink()
    assert main(["verify", str(small_scene)]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert len(errors) == 3 and all(line.startswith("error: ") for line in errors)
    for name in ("spikes/cam_00.dat", "images/cam_03/000020.exr", "sparse/0/images.bin"):
        assert sum(name in line for line in errors) == 1


@pytest.mark.parametrize(
    ("value", "good"), [("x", False), ("0", False), ("-1", False), ("", False), ("2", True), ("4, 2", True)]
)
def test_a_number_of_threads_that_openmp_would_pass_over(
    value: str, good: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", value)
    assert main(["--version"]) == (0 if good else 2)
    error = f"error: OMP_NUM_THREADS: expected a number of threads, 1 to 9999, found {value!r}; correct or unset it\n"
    assert capsys.readouterr().err == ("" if good else error)


def test_a_bad_number_of_threads_is_said_before_openmp_reads_it() -> None:
    done = python("-m", "spike4dgs.cli", "doctor", OMP_NUM_THREADS="x")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: OMP_NUM_THREADS: ") and done.stderr.count("\n") == 1, "no line of libgomp"


SEEDED = (
    "board-clip, fault-table, fit, import-frames, make-dataset, make-msdi-data, patterns, poses, record, "
    "run-benchmark, season make, season predict, train-msdi, train-spk2img, worlds, report dark-points, report "
    "dark-poses, report hard-cases, report modality, report oracle-ladder, report realism, report speed-error, report "
    "tuning"
)


@pytest.mark.parametrize("name", SEEDED.split(", "))
def test_a_bad_seed_is_refused(name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    function = cli.load(name)
    monkeypatch.setattr(cli, "_load", lambda _: functools.wraps(function)(lambda *_, **__: pytest.fail("work began")))
    option = "--fit-seed" if name == "season make" else "--seed"
    bits = 128 if name == "make-dataset" else 63
    for seed in (-1, 2**bits):
        assert main([*COMMANDS[name].example.split(), option, str(seed)]) == 2
        expected = f"error: {option}: expected a seed from 0 up, of {bits} bits, found {seed}; choose another seed\n"
        assert capsys.readouterr().err == expected


def test_a_full_disk_for_the_output_is_one_line() -> None:
    code = "import sys; from spike4dgs.cli import main; sys.exit(main(['--help']))"
    with open("/dev/full", "w") as full:
        done = subprocess.run([sys.executable, "-c", code], stdout=full, stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2 and done.stderr.startswith("error: the disk: expected room for the file")
    assert "Traceback" not in done.stderr


def test_a_folder_whose_name_is_no_text_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    name = os.fsdecode(os.fsencode(tmp_path) + b"/sc\xff")
    assert main(["inspect", name]) == 2
    assert capsys.readouterr().err.endswith(r"sc\xff'; rename the folder, or link to it by another name" + "\n")


def test_a_working_folder_whose_name_is_no_text_is_named(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/in\xff"))
    folder.mkdir()
    done = python("-m", "spike4dgs.cli", "doctor", cwd=folder)
    assert (done.returncode, done.stdout, done.stderr.count("\n")) == (2, "", 1)
    assert done.stderr.startswith("error: working folder: expected a name in UTF-8") and r"/in\xff'" in done.stderr


def test_a_working_folder_that_was_removed_is_one_line(tmp_path: Path) -> None:
    code = "import os, sys; os.rmdir(os.getcwd()); from spike4dgs.cli import main; sys.exit(main(['doctor']))"
    (tmp_path / "gone").mkdir()
    done = python("-c", code, cwd=tmp_path / "gone")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: working folder: expected a folder, found a removed one; change to one that exists\n"
