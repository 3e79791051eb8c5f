"""What people and catalogues read of a release: README.md, the dataset card, and croissant.json."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from spike4dgs.benchmark import croissant
from spike4dgs.benchmark.files import sha256_file, write_json, write_text
from spike4dgs.benchmark.release import index
from spike4dgs.benchmark.release.index import SceneEntry, Shard
from spike4dgs.benchmark.release.source import size_text

README = "README.md"
NAMES = (README, croissant.NAME)


def write_card(root: Path, name: str, scenes: Sequence[SceneEntry], shards: Sequence[Shard]) -> None:
    """Write README.md and croissant.json of a release whose release.json is there."""
    write_text(root / README, _readme(name, scenes, shards))
    write_json(root / croissant.NAME, _croissant(root, name, scenes, shards))


def _licence(scenes: Sequence[SceneEntry]) -> str:
    """Return the licence of all scenes; "other" where they differ."""
    found = {scene.licence for scene in scenes}
    return found.pop() if len(found) == 1 else "other"


def _description(scenes: Sequence[SceneEntry]) -> str:
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

{_description(scenes)} {size} in {len(shards)} uncompressed tar files.

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
- `SHA256SUMS`: `sha256sum -c SHA256SUMS` checks all files.
"""


def _croissant(root: Path, name: str, scenes: Sequence[SceneEntry], shards: Sequence[Shard]) -> dict[str, Any]:
    description = root / index.NAME
    first = croissant.file_object(index.NAME, description.stat().st_size, "application/json", sha256_file(description))
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
        _description(scenes),
        _licence(scenes),
        ours=True,
        distribution=[first, *tars, *lists],
        records=[croissant.record_set("scenes", "The scenes", index.NAME, "scenes", fields)],
    )
