"""make-dataset with Mitsuba: the audit, geometry and images that agree, and equal bytes after any interruption."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from changes import files_in
from scipy.ndimage import binary_erosion, map_coordinates

from spike4dgs.benchmark.scene.images import read_geometry
from spike4dgs.benchmark.scene.scene import Target, open_scene
from spike4dgs.cli import main
from spike4dgs.generators.profiles import PROFILES

# What processes do to the bytes of a scene, they do to those of few pixels and samples.
COARSE = {"views": (2, 4), "width": 32, "height": 20, "seconds": 0.003, "background_spp": 16, "target_spp": 16}
_START = f"""
import sys
from dataclasses import replace
from spike4dgs.cli import main
from spike4dgs.generators.profiles import PROFILES
PROFILES["tiny"] = replace(PROFILES["tiny"], **{COARSE})
sys.exit(main(sys.argv[1:]))
"""


def kill_when(process, pattern: str, folder: Path, count: int):
    """Send SIGKILL as soon as `count` files match; return at once if the process has ended."""
    until = time.monotonic() + 400
    while process.poll() is None and len(list(folder.glob(pattern))) < count and time.monotonic() < until:
        time.sleep(0.002)
    assert process.poll() is None, process.stdout.read().decode()
    os.kill(process.pid, signal.SIGKILL)
    process.communicate()
    assert process.returncode == -signal.SIGKILL


@pytest.fixture
def coarse(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(PROFILES, "tiny", replace(PROFILES["tiny"], **COARSE))


@pytest.mark.slow
def test_the_audit_finds_noise_and_no_more(tiny_data):
    report = json.loads((tiny_data / "car-0-tiny.report.json").read_text())
    ticks, noise = (report["audit"][k] for k in ("ticks", "noise"))
    assert not all(row["is_key"] for row in ticks["each"]) and len(ticks["each"]) == 3 * 2
    assert ticks["total"]["psnr_db"] > 36 and ticks["total"]["mean_percent"] < 5  # 16 samples a pixel
    assert ticks["total"]["mean_percent_moving"] > ticks["total"]["mean_percent"]
    assert noise["truth"]["whole_db"] > 40 and noise["truth"]["moving_db"] > noise["streams"]["moving_db"] > 30
    assert report["plan"]["keys"] == 5


@pytest.mark.slow
def test_flow_and_depth_of_a_scene_carry_its_images_over(tiny_data):
    """Ground truth warped by its flow is the next frame, and depth warps one camera's image into another's."""
    scene = open_scene(tiny_data / "car-0-tiny")
    tick, (camera, other) = 40, ("cam_04", "cam_00")
    here, later, there = (
        scene.ground_truth(Target(c, t)) for c, t in ((camera, tick), (camera, tick + 20), (other, tick))
    )
    geometry = read_geometry(scene.manifest.path(f"geometry/{camera}/{tick:06d}.exr"))
    v, u = np.mgrid[: here.shape[0], : here.shape[1]] + 0.5
    moving = binary_erosion(geometry.ids > 0, iterations=2)

    def sampled(image, uv):
        return map_coordinates(image, [uv[..., 1] - 0.5, uv[..., 0] - 0.5], order=1, mode="nearest")

    flowed = sampled(later, np.stack([u, v], -1) + geometry.flow)
    against = sampled(later, np.stack([u, v], -1) - geometry.flow)
    assert np.abs(flowed - here)[moving].mean() < 0.7 * np.abs(against - here)[moving].mean()
    assert (geometry.flow[geometry.ids == 0] == 0).all()
    a, b = scene.cameras[camera], scene.cameras[other]
    uv, _ = b.project(a.unproject(np.stack([u.ravel(), v.ravel()], 1), geometry.depth.ravel().astype(np.float64)))
    warped = sampled(there, uv.reshape(*here.shape, 2))
    seen = ((uv > 1) & (uv < [b.width - 1, b.height - 1])).all(1).reshape(here.shape)
    assert np.median(np.abs(warped - here)[seen]) < 0.6 * np.median(np.abs(there - here)[seen])


@pytest.mark.slow
def test_a_scene_killed_on_a_cluster_and_finished_here_has_the_bytes_of_one_made_beside_another(
    coarse, tmp_path, capfd
):
    """The cluster makes background, keys and truth, this process what is missing; of two workers each makes a scene.

    Two keys and a mask are taken away, so that there is something missing of each kind whenever the signal came.
    """
    from distributed import LocalCluster

    work, options = tmp_path / ".work/car-0-tiny", ["--profile", "tiny", "--out", str(tmp_path)]
    quiet = {"processes": True, "n_workers": 1, "threads_per_worker": 1, "dashboard_address": ":0"}
    with LocalCluster(**quiet, silence_logs=50) as cluster:
        command = [sys.executable, "-c", _START, "make-dataset", "car", *options]
        command += ["--scheduler", cluster.scheduler_address]
        killed = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        kill_when(killed, "scene/masks/*/*.png", work, 1)
    assert not (tmp_path / "car-0-tiny").exists()
    assert len(keys := sorted((work / "keys").glob("0*.npz"))) == 4
    for path in (*keys[1:3], next(work.glob("scene/masks/*/*.png"))):
        path.unlink()
    assert main(["make-dataset", "car", *options]) == 0
    output = capfd.readouterr().out
    assert "car-0-tiny: key frames 2/2" in output and "car-0-tiny: background" not in output
    assert json.loads((tmp_path / "car-0-tiny.report.json").read_text())["plan"]["keys"] == 4
    assert not (tmp_path / ".work").exists()
    beside = tmp_path / "beside"
    assert main(["make-dataset", "blank", "car", *options[:-1], str(beside), "--workers", "2"]) == 0
    assert "car-0-tiny (2 of 2): key frames 4/4" in capfd.readouterr().out
    found, whole = (files_in(folder / "car-0-tiny") for folder in (tmp_path, beside))
    assert found["manifest.json"] == whole["manifest.json"] and found == whole
    assert open_scene(beside / "blank-0-tiny").id == "blank-0-tiny"
    assert not (beside / ".work").exists()
