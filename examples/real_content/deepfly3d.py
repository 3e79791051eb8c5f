"""The sample recording of DeepFly3D as footage that `spike4dgs import-frames` reads.

    git clone https://github.com/NeLy-EPFL/DeepFly3D && git -C DeepFly3D checkout a99253c
    python examples/real_content/deepfly3d.py DeepFly3D fly

DeepFly3D (LGPL-3.0) films a tethered fly with seven synchronous cameras. Its repository has 15 frames of each, the
cameras as its bundle adjustment found them for this recording, and the joints of the legs that its network marked. This
writes fly/frames/cam_0/00.jpg and so on, fly/cameras.yml (OpenCV) and fly/points.csv.
"""

import argparse
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np

FRAMES = "tests/data/reference"
RESULT = "tests/data/reference_df3d/df3d_result.pkl"
CAMERAS, INSTANTS, WIDTH, HEIGHT = 7, 15, 960, 480
UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # theirs has y down, ours z up
METRES = 1e-3  # their unit is the millimetre, about


class NumbersOnly(pickle.Unpickler):
    """Reads numpy arrays and Python's own numbers, lists and maps; anything else in the file is refused."""

    ALLOWED = {("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numpy", "dtype"), ("numpy", "ndarray")}

    def find_class(self, module: str, name: str) -> Any:
        """Return one of four names of numpy. Raises UnpicklingError for all others."""
        if module.split(".")[0] != "numpy" or (module.split(".")[-1], name) not in self.ALLOWED:
            raise pickle.UnpicklingError(f"{module}.{name} is no array")
        return getattr(np._core.multiarray if module.endswith("multiarray") else np, name)


def matrix(values: Any) -> str:
    """Return a matrix as OpenCV writes it in YAML."""
    m = np.atleast_2d(np.asarray(values, np.float64))
    rows, cols = m.shape
    data = ", ".join(repr(float(v)) for v in m.ravel())
    return f"!!opencv-matrix\n      rows: {rows}\n      cols: {cols}\n      dt: d\n      data: [{data}]"


def camera_text(number: int, found: dict[str, Any]) -> str:
    """Return a camera: their principal point is (h / 2, w / 2), and the pose was adjusted with it."""
    R, t = np.asarray(found["R"]) @ UP.T, np.asarray(found["tvec"]).reshape(3, 1) * METRES
    u, _, vt = np.linalg.svd(R)  # a rotation to the last digits
    fields = {"camera_matrix": found["intr"], "distortion_coefficients": found["distort"], "R": u @ vt, "T": t}
    lines = [f"   {name}: {matrix(values)}" for name, values in fields.items()]
    return "\n".join([f"cam_{number}:", f"   image_width: {WIDTH}", f"   image_height: {HEIGHT}", *lines])


def point_rows(points2d: Any) -> list[str]:
    """Return the rows of points.csv. Theirs are (row, column) as shares of the image; 0 and 1 are none."""
    rows = ["camera,frame,point,x,y"]
    for camera, frame, point in np.ndindex(points2d.shape[:3]):
        row, column = points2d[camera, frame, point]
        if 0 < row < 1 and 0 < column < 1:
            rows.append(f"cam_{camera},{frame},{point},{column * WIDTH:.3f},{row * HEIGHT:.3f}")
    return rows


def main() -> None:
    """Write the footage."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("checkout", type=Path)
    parser.add_argument("out", type=Path)
    args = parser.parse_args()
    with open(args.checkout / RESULT, "rb") as file:
        found = NumbersOnly(file).load()
    for camera, instant in np.ndindex(CAMERAS, INSTANTS):
        target = args.out / f"frames/cam_{camera}/{instant:02d}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(args.checkout / FRAMES / f"camera_{camera}_img_{instant}.jpg", target)
    cameras = "\n".join(camera_text(k, found[k]) for k in range(CAMERAS))
    (args.out / "cameras.yml").write_text(f"%YAML:1.0\n---\n{cameras}\n")
    (args.out / "points.csv").write_text("\n".join(point_rows(found["points2d"])) + "\n")
    print(f"{args.out}: {CAMERAS} cameras, {INSTANTS} instants of {WIDTH}x{HEIGHT} pixels")


if __name__ == "__main__":
    main()
