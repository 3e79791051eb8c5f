"""gsply: the files of `export-ply`, activated as a viewer does."""

import json
import sys
from pathlib import Path

import gsply
import numpy as np

SH_C0 = 0.28209479177387814
inputs, answer = map(Path, sys.argv[1:])
frames = [gsply.plyread(path) for path in sorted((inputs / "ply").glob("*.ply"))]


def of_all(values):
    return np.concatenate([np.asarray(values(frame), np.float64) for frame in frames])


rotations = of_all(lambda frame: frame.quats)
values = {
    "positions": of_all(lambda frame: frame.means),
    "scales": np.exp(of_all(lambda frame: frame.scales)),
    "opacities": 1 / (1 + np.exp(-of_all(lambda frame: frame.opacities))),
    "grays": 0.5 + SH_C0 * of_all(lambda frame: frame.sh0[:, 0]),
    "rotations": rotations * np.sign(rotations[:, :1]),
}
answer.write_text(json.dumps({name: array.ravel().tolist() for name, array in values.items()}))
