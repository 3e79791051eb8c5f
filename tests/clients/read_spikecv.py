"""SpikeCV: its loader on a camera of `export-spikecv`, and on a stream that lies as in its own data sets.

It looks for ../spkData/datasets/NAME, from the folder that it runs in.
"""

import json
import os
import sys
from pathlib import Path

from cpu_torchvision import import_torchvision

inputs, answer = (Path(name).resolve() for name in sys.argv[1:])
os.chdir(inputs / "spikecv/work")

import_torchvision()
from spikecv.spkData.load_dat import SpikeStream, data_parameter_dict  # noqa: E402

values = {}
for name, path in (("export", "cam_01/cam_01.dat"), ("import", "recVidarReal2019/classA/ballon.dat")):
    stream = SpikeStream(**data_parameter_dict(path, "raw"), print_dat_detail=False)
    values[name] = stream.get_spike_matrix().ravel().astype(float).tolist()
answer.write_text(json.dumps(values))
