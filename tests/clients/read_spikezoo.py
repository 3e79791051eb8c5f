"""Spike-Zoo: its loader and its network `tfp` on a stream of a scene folder."""

import json
import sys
from pathlib import Path

import torch
from cpu_torchvision import import_torchvision

import_torchvision()
import spikezoo  # noqa: E402
from spikezoo.archs.tfp.nets import TFPModel  # noqa: E402

inputs, answer = map(Path, sys.argv[1:])
stream = str(inputs / "scene/spikes/cam_01.dat")
spikes = spikezoo.load_vidar_dat(stream, height=24, width=40, out_format="tensor")
values = {"spikes": spikes.flatten().tolist(), "tfp": TFPModel()(torch.as_tensor(spikes)[None]).flatten().tolist()}
answer.write_text(json.dumps(values))
