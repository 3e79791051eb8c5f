"""A submission without a method: any program that writes a predictions folder, in any language, can be scored.

    python predictions_only.py SCENE PREDICTIONS

This one reads a scene folder's files with numpy alone, and writes for each scored (camera, tick) the mean image of
all training cameras around that tick. It imports nothing of the benchmark.
"""

import hashlib
import json
import sys
from pathlib import Path

import numpy as np
import OpenEXR

HALF_WINDOW = 20  # ticks on each side of the instant


def read_json(path):
    """Return the content of a JSON file."""
    return json.loads(path.read_text(encoding="utf-8"))


def radiance(packed, meta, tick):
    """Return linear radiance [H, W] (1.0 = white) of packed ticks [T, bytes]: bits are pixels, lowest bit first."""
    height, width = meta["height"], meta["width"]
    window = packed[max(0, tick - HALF_WINDOW) : tick + HALF_WINDOW]
    spikes = np.unpackbits(window, axis=1, count=height * width, bitorder="little")
    image = spikes.mean(axis=0, dtype=np.float32).reshape(height, width) / np.float32(meta["radiance_gain"])
    return image[::-1] if meta["sensor"]["rows_bottom_up"] else image


def predict(scene, out):
    """Write the images, their hashes, and who made them."""
    meta, targets = read_json(scene / "scene.json"), read_json(scene / "targets.json")["targets"]
    size = (meta["height"] * meta["width"] + 7) // 8  # bytes of a tick
    training = meta["splits"][meta["default_split"]]["train"]
    streams = [np.memmap(scene / meta["streams"][camera], np.uint8, "r").reshape(-1, size) for camera in training]
    sums = []
    for target in targets:
        image = np.mean([radiance(packed, meta, target["tick"]) for packed in streams], axis=0)
        path = out / target["camera"] / f"{target['tick']:06d}.exr"
        path.parent.mkdir(parents=True, exist_ok=True)
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": np.ascontiguousarray(image, np.float16)}).write(str(path))
        sums.append(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.relative_to(out).as_posix()}\n")
    (out / "SHA256SUMS").write_text("".join(sums))
    info = {"schema": "spike4dgs-prediction/1", "method": {"name": "mean-of-cameras"}, "scene": meta["id"]}
    (out / "prediction.json").write_text(json.dumps(info))


if __name__ == "__main__":
    predict(*map(Path, sys.argv[1:]))
