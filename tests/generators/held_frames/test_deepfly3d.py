"""`examples/real_content/deepfly3d.py`, on a checkout that is made here: cameras and marks still agree."""

from __future__ import annotations

import importlib.util
import pickle
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
from PIL import Image

from spike4dgs.benchmark.exchange.camera_files import read_camera_files
from spike4dgs.benchmark.exchange.marked_points import read_marked_points
from spike4dgs.generators.held_frames.footage import find_footage
from spike4dgs.method.self_calibration.reprojection import reprojection

SCRIPT = Path(__file__).resolve().parents[3] / "examples/real_content/deepfly3d.py"
CAMERAS, INSTANTS, POINTS = 7, 15, 6


def script() -> ModuleType:
    spec = importlib.util.spec_from_file_location("deepfly3d", SCRIPT)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def write_checkout(folder: Path) -> None:
    """A ring of cameras in DeepFly3D's form: y down, millimetres, marks as shares (row, column), 0 where unseen."""
    rng = np.random.default_rng(0)
    points, found = rng.uniform(-1, 1, (INSTANTS, POINTS, 3)), {}
    points2d = np.zeros((CAMERAS, INSTANTS, POINTS, 2))
    (folder / "tests/data/reference").mkdir(parents=True)
    (folder / "tests/data/reference_df3d").mkdir()
    for c in range(CAMERAS):
        R = cv2.Rodrigues(np.array([0.0, 0.6 * c, 0.0]))[0]
        t, K = np.array([0.1, 0.2, 110.0]), np.array([[16000.0, 0, 480], [0, 15900.0, 240], [0, 0, 1]])
        found[c] = {"R": R, "tvec": t, "intr": K, "distort": np.zeros(5)}
        seen = (points @ R.T + t) @ K.T
        points2d[c] = (seen[..., :2] / seen[..., 2:])[..., ::-1] / (480, 960)
        for k in range(INSTANTS):
            Image.new("L", (960, 480), 10 * k).save(folder / f"tests/data/reference/camera_{c}_img_{k}.jpg")
    points2d[3] = 0
    (folder / "tests/data/reference_df3d/df3d_result.pkl").write_bytes(pickle.dumps(found | {"points2d": points2d}))


def test_cameras_and_marks_agree_after_the_conversion(tmp_path: Path) -> None:
    write_checkout(tmp_path / "checkout")
    command = [sys.executable, str(SCRIPT), str(tmp_path / "checkout"), str(tmp_path / "fly")]
    subprocess.run(command, check=True, capture_output=True)
    footage = find_footage(tmp_path / "fly/frames")
    assert [(f.frames, f.width, f.height) for f in footage.values()] == [(INSTANTS, 960, 480)] * CAMERAS
    cameras = read_camera_files(tmp_path / "fly/cameras.yml", sorted(footage), (960, 480))
    found = reprojection(cameras, read_marked_points(tmp_path / "fly/points.csv"))
    for name, errors in found.items():
        assert len(errors.together) == (0 if name == "cam_3" else INSTANTS * POINTS)
        assert np.max(errors.left_out, initial=0) < 0.05  # half a pixel, or a swapped axis, is far more
    assert cameras[0].center[2] == pytest.approx(0.2e-3, abs=1e-6)  # up is -y, in metres


def test_a_pickle_of_anything_else_is_refused(tmp_path: Path) -> None:
    class Hostile:
        def __reduce__(self) -> tuple[object, tuple[str]]:
            return Path.mkdir, (tmp_path / "made",)  # type: ignore[return-value]

    (tmp_path / "bad.pkl").write_bytes(pickle.dumps({"R": Hostile()}))
    with open(tmp_path / "bad.pkl", "rb") as file, pytest.raises(pickle.UnpicklingError, match="is no array"):
        script().NumbersOnly(file).load()
    assert not (tmp_path / "made").exists()
