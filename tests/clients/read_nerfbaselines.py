"""nerfbaselines: `load_dataset` finds the loader, the projection is its own."""

import json
import sys
from pathlib import Path

import numpy as np
from nerfbaselines.cameras import project
from nerfbaselines.datasets import load_dataset

inputs, answer = map(Path, sys.argv[1:])
dataset = load_dataset(str(inputs / "nerfstudio"), split="train", features=frozenset())
points = np.load(inputs / "points.npy").astype(np.float32)
order = np.argsort([Path(path).name for path in dataset["image_paths"]])
values = {
    "points": [float(x) for i in order for x in project(dataset["cameras"][int(i)], points).ravel()],
    "images": [float(dataset["images"][i].mean()) for i in order],
}
answer.write_text(json.dumps(values))
