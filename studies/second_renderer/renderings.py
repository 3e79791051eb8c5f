"""The renderings of a check by both renderers, kept as files: a killed study resumes."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from spike4dgs.benchmark.arrays import Float32
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import atomic_path, sha256_json
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import read_rgb
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.worlds import WorldScene
from spike4dgs.studies.second_renderer.checks import Check
from spike4dgs.studies.second_renderer.export import Shot, write_scene

SEEDS = (1, 2)  # of two renderings, whose noise is independent
INSTALLED = Path(".bpy") / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
_SCRIPT = Path(__file__).with_name("blender_script.py")
_ASK = "import bpy; print('Blender', bpy.app.version_string)"


@dataclass(frozen=True)
class Blender:
    """An interpreter that has `bpy`, and the version of Blender."""

    python: Path
    version: str


def find_blender(python: Path | None) -> Blender:
    """Return the interpreter `python`, or else that of the environment `.bpy` or this one, if it has `bpy`.

    Raises UserError with how to install it.
    """
    own = [Path(sys.executable)] if find_spec("bpy") else []
    candidates = [python] if python else [path for path in (INSTALLED, *own) if path.exists()]
    for candidate in candidates:
        try:
            told = subprocess.run([candidate, "-c", _ASK], capture_output=True, text=True, timeout=120).stdout
        except (OSError, subprocess.SubprocessError):
            continue
        if found := [line for line in told.splitlines() if line.startswith("Blender ")]:
            return Blender(candidate.absolute(), found[-1].removeprefix("Blender "))
    fix = "run `python3.11 -m venv .bpy && .bpy/bin/pip install bpy==5.0.1`, or name one by --python"
    there = "none" if python is None else f"{python}, which cannot import it"
    raise problem("the second renderer", "an interpreter that has Blender's module bpy", there, fix)


def kept(path: Path, key: object, make: Callable[[], Float32]) -> Float32:
    """Return the array of a file of the same key, or make it and write the file."""
    own = sha256_json(key)
    try:
        with open(path, "rb") as opened, np.load(opened) as file:  # NumPy leaves a damaged one open
            if str(file["key"]) == own:
                return np.asarray(file["images"])
    except (OSError, KeyError, ValueError, EOFError, BadZipFile):
        pass  # no file, or a damaged one
    images = make()
    with atomic_path(path) as part:
        np.savez(part, key=np.array(own), images=images)
    return images


def render_ours(world: WorldScene, cameras: Sequence[Camera], t_s: float, samples: int) -> Float32:
    """Return our reference loop's images [2, C, H, W, 3] with two seeds: whole paths, every pixel traced."""
    images = []
    for seed in SEEDS:
        renderer = MultiViewRenderer(world, cameras, seed=seed, spp=1, background_spp=1, color=True)
        images.append(renderer.reference_frames(t_s, samples))
    return np.stack(images)


def render_second(
    blender: Blender, check: Check, world: WorldScene, cameras: Sequence[Camera], t_s: float, samples: int
) -> Float32:
    """Return the second renderer's images [2, C, H, W, 3] with two seeds, in the world's scene units.

    Raises UserError with its last words where it fails.
    """
    folder = Path(tempfile.mkdtemp(prefix="spike4dgs-"))
    try:
        shots = [Shot(c, seed, folder / f"{c.id}_{seed}.exr") for seed in SEEDS for c in cameras]
        write_scene(folder / "scene.npz", world, t_s, shots, samples, check.sky, check.coats)
        command = [blender.python, _SCRIPT, folder / "scene.npz"]
        done = subprocess.run(command, capture_output=True, text=True, env={**os.environ, "PYTHONNOUSERSITE": "1"})
        if done.returncode != 0:
            words = (done.stderr.strip() or done.stdout.strip() or f"exit code {done.returncode}").splitlines()[-1]
            raise problem(f"{blender.python} {_SCRIPT.name}", "a rendering", words, "run the same with bpy 5.0.1")
        shape = (cameras[0].height, cameras[0].width)
        images = np.stack([read_rgb(shot.out, shape) for shot in shots])
        return np.asarray(images.reshape(len(SEEDS), len(cameras), *shape, 3) * np.float32(world.exposure))
    finally:
        shutil.rmtree(folder, ignore_errors=True)
