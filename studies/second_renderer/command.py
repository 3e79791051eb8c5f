"""`report second-renderer`: one tick of three worlds by Cycles, next to our renderer."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import Positional

from spike4dgs.benchmark.arrays import Float32, Mask
from spike4dgs.benchmark.environment import command_line, environment, harness, utc_now
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json, write_text
from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.generators.profiles import HELD_OUT_VIEW, RATE_HZ, SPLIT_PROFILES, Job
from spike4dgs.generators.render_tasks import cameras_of, renderer_of, world_of
from spike4dgs.generators.rendering.render import MultiViewRenderer
from spike4dgs.generators.worlds import WORLDS, WorldScene
from spike4dgs.studies.kit.checkout import code_now
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.second_renderer.checks import BOTH, CHECKS, NATIVE, PLAIN, WHOLE, Check
from spike4dgs.studies.second_renderer.comparison import compare, kinds, ratios
from spike4dgs.studies.second_renderer.picture import Row, write_picture
from spike4dgs.studies.second_renderer.renderings import SEEDS, Blender, find_blender, kept, render_ours, render_second

FORMAT = "spike4dgs-second-renderer/1"
_VARIANT, _TICK, _PROFILE = 10, 200, "small"  # of development; the middle of the clip


@dataclass(frozen=True, eq=False)
class Study:
    """One world at the study's tick, and where its renderings are kept."""

    job: Job
    folder: Path
    samples: int
    code: str  # a digest of it
    renderer: str  # the second one's version

    @property
    def world(self) -> WorldScene:
        """The world as the dataset has it."""
        return world_of(self.job)

    @property
    def t_s(self) -> float:
        """The time of the tick."""
        return float(_TICK / RATE_HZ)

    def cameras(self, views: tuple[int, ...]) -> list[Camera]:
        """Return cameras of the array."""
        return [cameras_of(self.job)[view] for view in views]

    def kept(self, name: str, make: Any, *arguments: Any) -> Float32:
        """Return the images of this name, which `make` of the arguments renders if they are not there yet."""
        key = {"job": self.job.settings, "tick": _TICK, "samples": self.samples, "code": self.code, "name": name}
        key |= {"renderer": self.renderer}
        return kept(self.folder / f"{name}.npz", key, partial(make, *arguments))


def second_renderer(
    worlds: Positional[tuple[str, ...]] = ("car", "turntable", "bird"),
    *,
    python: Path | None = None,
    samples: int = 512,
    out: Path = Path("runs/second-renderer"),
) -> int:
    """Render one tick of worlds with Cycles and with our renderer: OUT/second_renderer.md, .json and .png.

    Each check changes a world so that one cause of differences is left; without any, both have to agree. A killed study
    resumes.

    Args:
        worlds: Names of worlds, at development variant 10.
        python: An interpreter that has Blender's module `bpy`; by default that of the environment `.bpy`.
        samples: Paths per pixel of each of two renderings by both renderers.
        out: Folder for the results.
    """
    known = WORLDS.all_names  # the others have mirrors, glass and flashes, which the scene for Cycles has not
    if unknown := [name for name in worlds if name not in known]:
        raise problem("worlds", f"some of {', '.join(known)}", ", ".join(unknown), "correct the names")
    blender, start, records, rows = find_blender(python), utc_now(), [], []
    profile = SPLIT_PROFILES[_PROFILE]
    for name in worlds:
        job = Job(name, _VARIANT, 0, _PROFILE, profile, profile.seconds)
        record, row = measure(Study(job, out / "renderings" / name, samples, code_now(), blender.version), blender)
        records.append(record)
        rows.append(row)
    report = {
        "format": FORMAT, "renderer": f"Cycles of Blender {blender.version}", "variant": _VARIANT, "tick": _TICK,
        "profile": _PROFILE, "samples": samples, "started": start, "finished": utc_now(), "command": command_line(),
        "harness": harness(), "environment": environment("cpu"), "worlds": records,
    }  # fmt: skip
    write_json(out / "second_renderer.json", report)
    write_text(out / "second_renderer.md", to_markdown(records))
    write_picture(out / "second_renderer.png", rows)
    print(f"written: {out}/second_renderer.md, .json, .png")
    return 0


def measure(study: Study, blender: Blender) -> tuple[dict[str, Any], Row]:
    """Return the record of a world, and its row of the picture."""
    checks = [check for check in CHECKS if check.applies(study.world)]
    images = {check.id: rendered(study, blender, check) for check in checks}
    stored = study.kept("stored", render_stored, study)
    masks = moving(study, BOTH)
    record = {
        "world": study.job.world,
        "checks": [
            {
                "check": c.id,
                "differs": c.differs,
                "view": view,
                **_compared(images[c.id][0][:, k], images[c.id][1][:, k], masks[view]),
            }
            for c in checks
            for k, view in enumerate(c.views)
        ],
        "materials": _materials(study, images[WHOLE], images[NATIVE]),
        "stored": {
            "our reference": _compared(images[WHOLE][0][:, 0], stored, masks[HELD_OUT_VIEW]),
            "Cycles": _compared(images[WHOLE][1][:, 0], stored, masks[HELD_OUT_VIEW]),
        },
    }
    ours, second = (x[:, 0].mean(0) for x in images[WHOLE])
    grey = [x[:, 0].mean(0) for x in images[PLAIN]]
    return record, Row(study.job.world, ours, second, stored.mean(0), (grey[0], grey[1]))


def rendered(study: Study, blender: Blender, check: Check) -> tuple[Float32, Float32]:
    """Return the images [2, C, H, W, 3] of a check by our renderer and by the second one."""
    start, world, cameras = time.perf_counter(), check.change(study.world), study.cameras(check.views)
    arguments = world, cameras, study.t_s, study.samples
    ours = study.kept(f"{check.ours or check.id}_ours", render_ours, *arguments)
    second = study.kept(f"{check.id}_second", render_second, blender, check, *arguments)
    print(f"{study.job.world} {check.id}: {time.perf_counter() - start:.0f} s", flush=True)
    return ours, second


def render_stored(study: Study) -> Float32:
    """Return the held-out view [2, H, W, 3] as the dataset's ground truth renders it, with two seeds."""
    camera = study.cameras((HELD_OUT_VIEW,))
    return np.stack([renderer_of(study.job, camera, truth=True, seed=s).keys(study.t_s)[0] for s in SEEDS])


def moving(study: Study, views: tuple[int, ...]) -> dict[int, Mask]:
    """Return where [H, W] moving objects are seen, by view."""
    renderer = MultiViewRenderer(study.world, study.cameras(views), seed=0, spp=1, background_spp=1)
    return dict(zip(views, renderer.object_masks(study.t_s), strict=True))


def _compared(ours: Float32, second: Float32, where: Mask) -> dict[str, Any]:
    found = compare(ours, second, where)
    return {region: {**of, "difference": asdict(of["difference"])} for region, of in found.items()}


def _materials(study: Study, *images: tuple[Float32, Float32]) -> dict[str, Any]:
    """Return for each kind of material its pixels in the held-out view and the median ratios of some checks."""
    pixels = kinds(study.world, study.cameras((HELD_OUT_VIEW,))[0], study.t_s)
    found = [ratios(ours[:, 0], second[:, 0], pixels) for ours, second in images]
    return {
        kind: {"pixels": of["pixels"], "median_ratios": [each[kind]["median_ratio"] for each in found]}
        for kind, of in found[0].items()
    }


# ---------------------------------------------------------------- the page

_REGIONS = ("whole", "moving", "static")
_HEADS = (
    "world", "check", "camera", "difference: whole, moving, static, dB", "noise of ours, of Cycles, dB",
    "mean relative difference: whole, moving, static, %", "ratio of the means",
)  # fmt: skip


def to_markdown(records: list[dict[str, Any]]) -> str:
    """Return the tables of the study."""
    rows, materials, stored = [], [], []
    for record in records:
        name = record["world"]
        rows += [[name, of["check"], f"cam_{of['view']:02d}", *_cells(of)] for of in record["checks"]]
        stored += [[name, other, *_cells(of)] for other, of in record["stored"].items()]
        for kind, of in record["materials"].items():
            materials.append([name, kind, str(of["pixels"]), *(f"{ratio:.3f}" for ratio in of["median_ratios"])])
    met = {of["check"] for record in records for of in record["checks"]}
    lines = [
        "# The second renderer next to ours", "",
        *markdown(("check", "the renderers may differ in"), [(c.id, c.differs) for c in CHECKS if c.id in met]), "",
        *markdown(_HEADS, rows), "", "Median ratio of radiance, Cycles to ours, by material:", "",
        *markdown(("world", "material", "pixels", "nearest coat", "its own coat"), materials), "",
        "What the dataset stores, against both renderers:", "",
        *markdown(("world", "against", _HEADS[3], "noise of that, of what is stored, dB", *_HEADS[5:]), stored),
    ]  # fmt: skip
    return "\n".join([*lines, ""])


def _cells(of: Mapping[str, Any]) -> list[str]:
    whole, found = of["whole"], [of[region] for region in _REGIONS]
    bounds = (f"{'> ' if f['difference']['at_least'] else ''}{f['difference']['value']:.1f}" for f in found)
    return [
        " / ".join(bounds),
        " / ".join(f"{value:.1f}" for value in whole["noise_db"]),
        " / ".join(f"{f['mean_percent']:.1f}" for f in found),
        f"{whole['mean_ratio']:.4f}",
    ]
