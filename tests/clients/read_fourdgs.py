"""fourdgs: the sequence of `export-ply` converted to its model, and that written to its container and read."""

import json
import sys
from pathlib import Path

import fourdgs
import numpy as np
from fourdgs.convert import convert_ply_sequence

FPS = 30.0
inputs, answer = map(Path, sys.argv[1:])
gaussians, seconds = convert_ply_sequence(str(inputs / "ply"), fps=FPS)
frames = range(len(list((inputs / "ply").glob("*.ply"))))
states = [gaussians.state_at((frame + 0.5) / FPS) for frame in frames]

gaussians.source_index = np.arange(gaussians.count)  # chunks are stored in another order
gaussians.source_group = np.zeros(gaussians.count, np.int64)
container = str(answer.with_suffix(".4dgs"))
fourdgs.write(container, gaussians, seconds, options=fourdgs.WriteOptions(profile="fine", preserve_source_ids=True))
read = fourdgs.read(container).gaussians
order = np.argsort(read.source_index)
values = {
    "positions": np.concatenate([state["centers"] for state in states]),
    "opacities": np.concatenate([state["opacity"] for state in states]),
    "positions, written and read": read.positions[order],
    "opacities, written and read": read.colors[order, 3],
}
answer.write_text(json.dumps({name: array.ravel().tolist() for name, array in values.items()}))
