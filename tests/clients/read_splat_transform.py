"""splat-transform, a program for Node: each file of `export-ply` as a table, which it writes."""

import csv
import json
import subprocess
import sys
from pathlib import Path

import numpy as np

inputs, answer = map(Path, sys.argv[1:])
columns: dict[str, list[float]] = {}
for path in sorted((inputs / "ply").glob("*.ply")):
    table = answer.with_name(f"{path.stem}.csv")
    subprocess.run(["splat-transform", "--gpu", "cpu", "--overwrite", path, table], check=True, capture_output=True)
    with open(table, newline="") as file:
        for row in csv.DictReader(file):
            for name, value in row.items():
                columns.setdefault(name, []).append(float(value))


def of(*names):
    return np.stack([np.asarray(columns[name]) for name in names], axis=1)


SH_C0 = 0.28209479177387814
rotations = of("rot_0", "rot_1", "rot_2", "rot_3")
rotations /= np.linalg.norm(rotations, axis=1, keepdims=True)
values = {
    "positions": of("x", "y", "z"),
    "scales": np.exp(of("scale_0", "scale_1", "scale_2")),
    "opacities": 1 / (1 + np.exp(-of("opacity"))),
    "grays": 0.5 + SH_C0 * of("f_dc_0"),
    "rotations": rotations * np.sign(rotations[:, :1]),
}
answer.write_text(json.dumps({name: array.ravel().tolist() for name, array in values.items()}))
