"""COLMAP: its reader of models, and the projection of its cameras."""

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap

inputs, answer = map(Path, sys.argv[1:])
model = pycolmap.Reconstruction(str(inputs / "colmap/sparse/0"))
points, seen = np.load(inputs / "points.npy"), []
for image in sorted(model.images.values(), key=lambda image: image.name):
    pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world  # called since 3.12
    local = points @ pose.rotation.matrix().T + pose.translation
    seen.append(np.stack([model.cameras[image.camera_id].img_from_cam(point) for point in local]))
answer.write_text(json.dumps({"points": np.stack(seen).ravel().tolist()}))
