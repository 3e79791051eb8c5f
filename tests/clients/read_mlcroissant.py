"""mlcroissant: the description of a scene validates, and its records are those of the scene."""

import json
import sys
from pathlib import Path

import mlcroissant

inputs, answer = map(Path, sys.argv[1:])
dataset = mlcroissant.Dataset(jsonld=str(inputs / "scene/croissant.json"))
images = list(dataset.records("images"))
values = {
    "targets": [float(record["targets/tick"]) for record in dataset.records("targets")],
    "images": [float(record["images/tick"]) for record in images],
    "times": [float(record["images/t_us"]) for record in images],
    "errors": [float(len(dataset.metadata.ctx.issues.errors))],
}
answer.write_text(json.dumps(values))
