"""croissant.json: the scene described for data catalogues and loaders (MLCommons Croissant 1.0, JSON-LD).

A function of the scene alone: it holds no time of day and nothing else that varies between two runs. Therefore it
also lacks `datePublished` and `url`, which whoever publishes a scene knows.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import read_json, sha256_file, write_json

NAME = "croissant.json"
_TERMS = (
    "citeAs column conformsTo equivalentProperty extract field fileObject fileProperty fileSet format includes "
    "isLiveDataset jsonPath key md5 parentField path recordSet references regex repeated replace samplingRate "
    "separator source subField transform"
).split()
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    **{term: f"cr:{term}" for term in _TERMS},
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
}
_JSON, _BYTES, _NPZ = "application/json", "application/octet-stream", "application/zip"
_EXR, _PNG = "image/x-exr", "image/png"
# Files that are many: what is in them, their pattern, their type.
_FILE_SETS = {
    "images": ("Ground-truth linear radiance, half float", "images/*/*.exr", _EXR),
    "masks": ("Moving region of each image", "masks/*/*.png", _PNG),
    "geometry": ("Depth, instance ids and optical flow", "geometry/*/*.exr", _EXR),
    "calibration-flat": ("Spike streams under uniform light", "calibration/flat/*.dat", _BYTES),
    "calibration-dark": ("Spike streams without light", "calibration/dark/*.dat", _BYTES),
    "calibration-flat-counts": ("Counts of the spikes under uniform light", "calibration/flat/*.npz", _NPZ),
    "calibration-dark-counts": ("Counts of the spikes without light", "calibration/dark/*.npz", _NPZ),
    "truth": ("True gain and dark maps of the sensors", "truth/*.npz", _NPZ),
    "conventional": ("Frames of a conventional camera, 8-bit sRGB", "conventional/*/*.png", _PNG),
    "events": ("Events: t, x, y, p", "events/*.npz", _NPZ),
    "sparse": ("Cameras as a COLMAP model", "sparse/0/*.bin", _BYTES),
}


def write_croissant(root: Path, meta: dict[str, Any], description: str) -> None:
    """Write croissant.json for a scene folder that is complete but for this file and its manifest.

    `meta` is scene.json; `description` one or two sentences. Streams and descriptions are listed with their SHA-256,
    images and the like as file sets. The record sets `targets` (camera, tick) and `images` (camera, tick, path) can be
    read with mlcroissant.
    """
    names = ("scene", "targets", "transforms_train", "transforms_test", "transforms_all")
    single = {f"{name}.json": _JSON for name in names}
    single |= {stream: _BYTES for stream in meta["streams"].values()}
    found = {name: value for name, value in _FILE_SETS.items() if any(root.glob(value[1]))}
    files = [
        file_object(name, (root / name).stat().st_size, kind, sha256_file(root / name)) for name, kind in single.items()
    ]
    sets = [_file_set(name, *value) for name, value in found.items()]
    ours = meta["source"]["kind"] not in ("spikecv", "frames")  # we do not know whose an import is
    about = (meta["id"], description, meta["licence"])
    write_json(root / NAME, dataset(*about, ours=ours, distribution=[*files, *sets], records=_records(root)))


def dataset(
    name: str,
    description: str,
    licence: str,
    *,
    ours: bool,
    distribution: list[dict[str, Any]],
    records: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return a dataset of files and record sets; `ours` names us as the creator."""
    return {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": name,
        "description": description,
        "license": _licence(licence),
        **({"creator": {"@type": "sc:Organization", "name": "Spike4DGS"}} if ours else {}),
        "version": "1.0.0",  # of the format; the contents in manifest.json make the revision of the data
        "distribution": distribution,
        "recordSet": records,
    }


def _licence(name: str) -> str:
    """Return the address of an SPDX licence such as CC0-1.0; any other text as it is."""
    is_spdx = re.fullmatch(r"[A-Z][A-Za-z0-9.]*(-[A-Za-z0-9.]+)*-\d[A-Za-z0-9.]*", name)
    return f"https://spdx.org/licenses/{name}.html" if is_spdx else name


def file_object(name: str, size: int, kind: str, sha256: str) -> dict[str, Any]:
    """Return a file of a dataset: its path, bytes, type and hash."""
    return {
        "@type": "cr:FileObject",
        "@id": name,
        "name": name.rpartition("/")[2],
        "contentUrl": name,
        "contentSize": f"{size} B",
        "encodingFormat": kind,
        "sha256": sha256,
    }


def _file_set(name: str, description: str, pattern: str, kind: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"{name}-files",  # the record sets have the plain names
        "name": f"{name}-files",
        "description": description,
        "encodingFormat": kind,
        "includes": pattern,
    }


def _records(root: Path) -> list[dict[str, Any]]:
    """Return the lists that a loader can iterate over, without empty ones, which loaders cannot read.

    Both come from JSON: mlcroissant reads no EXR, not even a file's name.
    """
    found = []
    if read_json(root / "targets.json", "the scored images")["targets"]:
        fields = {"camera": ("Held-out camera", "sc:Text"), "tick": ("Tick of the image", "sc:Integer")}
        found.append(record_set("targets", "The scored images of the default split", "targets.json", "targets", fields))
    if read_json(root / "transforms_all.json", "all images")["frames"]:
        fields = {
            "camera": ("Camera", "sc:Text"),
            "tick": ("Tick at whose start the image is taken", "sc:Integer"),
            "t_us": ("The same in microseconds", "sc:Float"),
            "file_path": ("Path in the scene folder", "sc:Text"),
        }
        found.append(record_set("images", "The ground-truth images", "transforms_all.json", "frames", fields))
    return found


def record_set(
    name: str, description: str, file: str, items: str, fields: dict[str, tuple[str, str]]
) -> dict[str, Any]:
    """Return a record for each object in the list `items` of a JSON file; `fields` has their description and type."""

    def field(key: str, about: str, kind: str) -> dict[str, Any]:
        named = {"@type": "cr:Field", "@id": f"{name}/{key}", "name": key, "description": about, "dataType": kind}
        return {**named, "source": {"fileObject": {"@id": file}, "extract": {"jsonPath": f"$.{items}[*].{key}"}}}

    made = [field(key, *value) for key, value in fields.items()]
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "description": description, "field": made}
