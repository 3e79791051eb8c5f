"""The choice of the Mitsuba variant, and equal images by the scalar one."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.cli import main
from spike4dgs.generators.rendering import mitsuba_variant
from spike4dgs.generators.rendering.mitsuba_variant import FAST, OVERRIDE, SAFE, load_mitsuba

_PICK = "from spike4dgs.generators.rendering.mitsuba_variant import pick_variant; print(pick_variant())"
_RENDER = """
import sys
import numpy as np
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS
world = WORLDS["turntable"].build(0, 0, 0.02)
renderer = MultiViewRenderer(world, cameras(world, 32, 20, (4,)), seed=0, spp=32, background_spp=128)
np.savez(
    sys.argv[1], key=renderer.keys(0.01), again=renderer.keys(0.01), background=renderer.background,
    changed=renderer.changed(0.01), traced=renderer.traced(0.01), mask=renderer.object_masks(0.01),
    depth=renderer.depths(0.01), crn=renderer.crn_frames(0.01),
)
"""


def python(code: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """Run `code` in a child process with a clean choice of variant and the given environment on top."""
    env = {k: v for k, v in os.environ.items() if k not in (OVERRIDE, "DRJIT_LIBLLVM_PATH")} | environment
    return subprocess.run(
        [sys.executable, "-c", code, *arguments], capture_output=True, text=True, env=env, timeout=120, check=False
    )


def test_a_libllvm_that_does_not_load_means_the_scalar_variant_and_one_line(tmp_path: Path):
    bogus = tmp_path / "libLLVM.so"
    bogus.write_bytes(b"not a library")
    environment = {"DRJIT_LIBLLVM_PATH": str(bogus), "XDG_CACHE_HOME": str(tmp_path)}
    first = python(_PICK, **environment)
    assert first.returncode == 0 and first.stdout.strip() == SAFE
    lines = first.stderr.strip().splitlines()
    assert len(lines) == 1 and FAST in lines[0] and "libllvm19" in lines[0]
    assert "not work here (ImportError: " in lines[0]  # the reason
    (answer,) = (tmp_path / "spike4dgs").glob("mitsuba-*.json")
    answer.write_text('{"why_not": "remembered"}')  # the second process reads the answer and does not probe
    second = python(_PICK, **environment)
    assert second.stdout.strip() == SAFE and "(remembered)" in second.stderr
    answer.write_text("{ damaged")
    assert python(_PICK, **environment).stdout.strip() == SAFE


@pytest.mark.parametrize(
    ("body", "timeout_s", "expected"),
    [("kill -9 $$", 60.0, "killed by SIGKILL"), ("exec sleep 60", 0.1, "no answer")],
)
def test_a_failure_that_may_pass_is_not_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, body: str, timeout_s: float, expected: str
):
    child, run = tmp_path / "python", subprocess.run
    child.write_text(f"#!/bin/sh\n{body}\n")
    child.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(child))
    monkeypatch.setattr(subprocess, "run", lambda *args, **options: run(*args, **options | {"timeout": timeout_s}))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.delenv(OVERRIDE, raising=False)
    assert mitsuba_variant.diagnose().why_not_fast.startswith(expected)
    assert not list(tmp_path.glob("spike4dgs/mitsuba-*"))


def test_an_answer_without_a_file_of_llvm_is_kept_where_it_works(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A conda environment's libLLVM lies elsewhere; a failure is asked again, as LLVM may have been installed."""
    child, asked = tmp_path / "python", tmp_path / "asked"
    child.write_text(f"#!/bin/sh\necho >> {asked}\n. {tmp_path}/answer\n")
    child.chmod(0o755)
    monkeypatch.setattr(sys, "executable", str(child))
    monkeypatch.setattr(mitsuba_variant, "_LLVM_PATHS", ())
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    for name in (OVERRIDE, "DRJIT_LIBLLVM_PATH"):
        monkeypatch.delenv(name, raising=False)
    for answer, why_not, times in (("exit 3", "exit code 3", 2), ("echo works", "", 3)):
        (tmp_path / "answer").write_text(answer)
        assert [mitsuba_variant.diagnose().why_not_fast for _ in range(2)] == [why_not] * 2
        assert len(asked.read_text().splitlines()) == times


@pytest.fixture
def fresh_choice() -> Iterator[None]:
    """The variant is picked anew in the test, and after it."""
    mitsuba_variant.pick_variant.cache_clear()
    yield
    mitsuba_variant.pick_variant.cache_clear()


@pytest.mark.usefixtures("fresh_choice")
def test_asking_for_llvm_without_libllvm_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    bogus, out = tmp_path / "libLLVM.so", tmp_path / "data"
    bogus.write_bytes(b"not a library")
    for name, value in (("DRJIT_LIBLLVM_PATH", bogus), ("XDG_CACHE_HOME", tmp_path), (OVERRIDE, FAST)):
        monkeypatch.setenv(name, str(value))
    assert main(["make-dataset", "car", "--profile", "tiny", "--out", str(out)]) == 2
    assert "apt-get install libllvm19" in capsys.readouterr().err.splitlines()[-1]
    assert not out.exists() or not any(out.glob("*"))


@pytest.mark.usefixtures("fresh_choice")
def test_the_override_is_taken_or_refused(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(OVERRIDE, SAFE)
    assert mitsuba_variant.pick_variant() == SAFE
    monkeypatch.setenv(OVERRIDE, "gpu")
    mitsuba_variant.pick_variant.cache_clear()
    with pytest.raises(UserError, match=f"{OVERRIDE}.*gpu"):
        mitsuba_variant.pick_variant()


def test_scalar_and_vectorised_images_agree_within_noise(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
):
    if load_mitsuba().variant() != FAST:
        pytest.skip(f"{FAST} does not work here (no usable libLLVM)")
    paths = {variant: tmp_path / f"{variant}.npz" for variant in (SAFE, FAST)}
    child = python(_RENDER, str(paths[SAFE]), **{OVERRIDE: SAFE})
    assert child.returncode == 0, child.stderr
    monkeypatch.setattr(sys, "argv", ["", str(paths[FAST])])
    exec(_RENDER, {})  # this process has loaded the fast variant
    written = capfd.readouterr()
    assert not (child.stdout + child.stderr + written.out + written.err).strip()  # no warnings about samplers
    images = {}
    for variant, path in paths.items():
        with np.load(path) as data:
            images[variant] = dict(data)
    slow, fast = images[SAFE], images[FAST]
    for p in images.values():
        assert np.array_equal(p["key"], p["again"])
        assert np.array_equal(p["key"][~p["changed"]], p["background"][~p["changed"]])
        assert np.array_equal(p["key"][p["mask"]], p["crn"][p["mask"]])
    for name in ("mask", "traced"):
        assert (slow[name] != fast[name]).mean() < 0.002
    np.testing.assert_allclose(slow["depth"], fast["depth"], rtol=1e-3)
    difference = slow["key"] - fast["key"]
    assert np.abs(difference).mean() < 0.02
    assert abs(difference.mean()) < 0.002
