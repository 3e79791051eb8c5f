"""nerfstudio: its D-NeRF parser on transforms_*.json, its other parser on transforms.json."""

import json
import sys
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.dnerf_dataparser import DNeRFDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

inputs, answer = map(Path, sys.argv[1:])
data = inputs / "nerfstudio"
coordinates = torch.as_tensor(np.load(inputs / "pixels.npy")[:, ::-1].copy(), dtype=torch.float32)  # y, x
as_stored = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "downscale_factor": 1}
values = {"times": [], "rays": [], "rays, per-image intrinsics": []}


def by_name(parser, split):
    """Yield a camera's row for each image, in the order of their names."""
    outputs = parser.get_dataparser_outputs(split)
    for row in np.argsort([path.name for path in outputs.image_filenames]):
        yield outputs.cameras, int(row)


def rays(cameras, row):
    bundle = cameras.generate_rays(torch.full((len(coordinates), 1), row), coordinates)
    return torch.cat([bundle.origins, bundle.directions], dim=1).flatten().tolist()


for split in ("train", "test"):
    for cameras, row in by_name(DNeRFDataParserConfig(data=data).setup(), split):
        values["times"].append(float(cameras.times[row]))
        values["rays"] += rays(cameras, row)
    for cameras, row in by_name(NerfstudioDataParserConfig(data=data, **as_stored).setup(), split):
        values["rays, per-image intrinsics"] += rays(cameras, row)
answer.write_text(json.dumps(values))
