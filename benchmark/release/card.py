"""What people and catalogues read of a release: README.md, the dataset card, DATASHEET.md and croissant.json.

The datasheet answers the questions of Gebru et al., "Datasheets for Datasets" (CACM 64, 2021).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark import croissant
from spike4dgs.benchmark.files import sha256_file, write_json, write_text
from spike4dgs.benchmark.release import index
from spike4dgs.benchmark.release.index import SceneEntry, Shard
from spike4dgs.benchmark.release.source import size_text

README, DATASHEET = "README.md", "DATASHEET.md"
NAMES = (README, DATASHEET, croissant.NAME)


def write_card(root: Path, name: str, scenes: Sequence[SceneEntry], shards: Sequence[Shard]) -> None:
    """Write README.md, DATASHEET.md and croissant.json of a release whose release.json is there."""
    write_text(root / README, _readme(name, scenes, shards))
    write_text(root / DATASHEET, _datasheet(name, scenes, shards))
    write_json(root / croissant.NAME, _croissant(root, name, scenes, shards))


def _licence(scenes: Sequence[SceneEntry]) -> str:
    """Return the licence of all scenes; "other" where they differ."""
    found = {scene.licence for scene in scenes}
    return found.pop() if len(found) == 1 else "other"


def description(scenes: Sequence[SceneEntry]) -> str:
    """Return a sentence about the scenes of a release."""
    return f"{len(scenes)} scenes of spike-camera arrays: packed streams, poses, calibration and ground truth."


def _readme(name: str, scenes: Sequence[SceneEntry], shards: Sequence[Shard]) -> str:
    parts = list(dict.fromkeys(part for scene in scenes for part in scene.parts))
    rows = "\n".join(
        f"| {s.id} | {s.licence} | {' | '.join(size_text(s.parts.get(p, 0)) for p in parts)} | {size_text(s.bytes)} |"
        for s in scenes
    )
    size = size_text(sum(s.bytes for s in shards))
    return f"""---
pretty_name: Spike4DGS {name}
license: {_licence(scenes).lower()}
tags:
- spike-camera
- neuromorphic-vision
- webdataset
---

# Spike4DGS, release {name}

{description(scenes)} {size} in {len(shards)} uncompressed tar files.

    spike4dgs download all --from THIS_FOLDER --out data

fetches and unpacks scenes; `--scenes`, `--cameras`, `--parts` and `--window-ms` fetch less. THIS_FOLDER is an address
(https://, hf://, s3://, ...) or a path.

| scene | licence | {" | ".join(parts)} | all |
|---|---|{"---|" * (len(parts) + 1)}
{rows}

- `release.json`: scenes, their revisions and sizes, and the shards. The JSON file beside each tar lists its files:
  path in the scene folder, offset, bytes, SHA-256, and the SHA-256 of every MiB.
- The tars are a WebDataset: a sample is a camera of a scene, with its stream, calibration and images
  (`car-0-small/cam_00.spikes.dat`), or the scene's own files (`car-0-small/scene.scene.json`).
- `DATASHEET.md`: why the data were made, how, from what, and what they are for.
- `SHA256SUMS`: `sha256sum -c SHA256SUMS` checks all files.
"""


def _datasheet(name: str, scenes: Sequence[SceneEntry], shards: Sequence[Shard]) -> str:
    cameras, seconds = sum(len(s.streams) for s in scenes), sum(s.n_ticks / s.rate_hz for s in scenes)
    sizes = ", ".join(sorted({f"{s.width}x{s.height}" for s in scenes}))
    rates = ", ".join(sorted({f"{s.rate_hz:g}" for s in scenes}))
    licences = "\n".join(f"- {s.id} ({s.title}): {s.licence}" for s in scenes)
    return f"""# Datasheet of Spike4DGS, release {name}

## Motivation

To compare methods that reconstruct fast scenes in four dimensions from an array of spike cameras, sensors whose pixels
fire one-bit spikes. No recording of more than two such cameras is public. Made by the Spike4DGS developers.

## Composition

- {len(scenes)} scenes, {cameras} streams, {seconds:g} s of time in all; {sizes} pixels, {rates} ticks per second;
  {size_text(sum(s.bytes for s in shards))}.
- An instance is a scene: packed streams of its cameras, their poses and calibration, and of the held-out cameras the
  images that are scored. Scenes of `make-dataset` have depth, flow, object ids, frames and events too.
- `scene.json` of each scene states its `source`: the program, world, variant, seed and versions that made it, or the
  footage it shows. Splits and scored images are in it and in `targets.json`: train on `train`, never on ground truth.
- Errors known: the renderer's noise, which `make-dataset --audit` reports. Gaps of recordings are in `scene.json`.
- No person's data in scenes of `make-dataset`. The files need nothing from elsewhere.

## Collection and processing

Scenes of `make-dataset`: Mitsuba renders radiance, and a sensor model whose constants follow calibrations of a real
250x400 camera turns it into spikes; nothing is filmed. Recordings under uniform light and in the dark are kept as
counts. Everything can be made again with the same program, which is free.

## Uses

Reconstruction, view synthesis, image formation from spikes, calibration. Not for claims about a real camera that the
sensor model does not cover (`docs/sensor.md` of the program lists what it leaves out), nor as training data for methods
that are then scored on the same scenes.

## Distribution and licences

{licences}

## Maintenance

`release.json` names every scene's revision, the hash of what is fitted and scored; a changed scene has another. Errors
are mended in a new release, and old ones stay. The program's changelog tells what changed.
"""


def _croissant(root: Path, name: str, scenes: Sequence[SceneEntry], shards: Sequence[Shard]) -> dict[str, Any]:
    about = root / index.NAME
    first = croissant.file_object(index.NAME, about.stat().st_size, "application/json", sha256_file(about))
    tars = [croissant.file_object(s.file, s.bytes, "application/x-tar", s.sha256) for s in shards]
    lists = [croissant.file_object(s.index, s.index_bytes, "application/json", s.index_sha256) for s in shards]
    fields = {
        "id": ("Scene", "sc:Text"),
        "revision": ("Hash of what is fitted and scored", "sc:Text"),
        "licence": ("Licence", "sc:Text"),
        "bytes": ("Size of all files", "sc:Integer"),
    }
    return croissant.dataset(
        f"spike4dgs-{name}",
        description(scenes),
        _licence(scenes),
        ours=True,
        distribution=[first, *tars, *lists],
        records=[croissant.record_set("scenes", "The scenes", index.NAME, "scenes", fields)],
    )
