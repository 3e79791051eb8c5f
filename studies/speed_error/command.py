"""`report speed-error`: measure, then write OUT/index.html and OUT/speed_error.json."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Literal

from spike4dgs.benchmark.environment import choose_device, command_line, environment, harness
from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import write_json
from spike4dgs.benchmark.schemas import check_schema, load_schema
from spike4dgs.generators.make_dataset import SceneSettings
from spike4dgs.studies.speed_error.measurement import Measurement, Request, Size
from spike4dgs.studies.speed_error.runner import in_order, measure_all, measured_from_to

FORMAT = "spike4dgs-speed-error/1"
Room = Callable[[], Sequence[Measurement]]


def make_speed_error(make_dataset: Callable[..., int], *rooms: Room) -> Callable[..., int]:
    """Return the command, given the maker of scenes and the rooms' measurements, in the order of the page."""

    def speed_error(
        *,
        out: Path = Path("runs/speed-error"),
        size: Size = "whole",
        quick: bool = False,
        only: tuple[str, ...] = (),
        scene: Path | None = None,
        seed: int = 0,
        device: Literal["auto", "cpu", "cuda"] = "cpu",
        again: bool = False,
    ) -> int:
        """Measure every approximation of the project beside its exact twin, and how costs grow, in one run.

        Writes OUT/index.html, a page with plots that opens from the disk, and OUT/speed_error.json. Each measurement is
        kept in OUT/measurements as soon as it is done: the same command again goes on where a killed one was. Use a
        machine that does nothing else: other programs change the times, never the errors.

        Args:
            out: Folder for the page, the JSON and the scene.
            size: whole (about an hour on two cores), quick (ten minutes), or tiny (seconds, to try the command).
            quick: The same as --size quick.
            only: Measure these alone, by the ids in the page's sections, such as splat ssim.
            scene: A scene folder for the fits and the images; without it, OUT/scenes has a new one of the world car.
            seed: Seed of all random inputs.
            device: cpu, cuda, or auto: cuda where there is one. Most twins are measured on the CPU in any case.
            again: Measure again what OUT has already.
        """
        size = "quick" if quick else size
        device = choose_device(device)  # type: ignore[assignment]
        measurements = in_order(m for room in rooms for m in room())
        known = [m.id for m in measurements]
        if wrong := [name for name in only if name not in known]:
            raise problem("--only", f"ids among {', '.join(known)}", ", ".join(wrong), "correct the id")
        measurements = [m for m in measurements if (m.id in only if only else size in m.sizes)]

        @cache
        def made() -> Path:
            if scene is not None:
                return scene
            profile = "small" if size == "whole" else "tiny"
            make_dataset([SceneSettings(profile, seed).job("car")], out / "scenes")
            return out / "scenes" / f"car-0-{profile}"

        key = {"size": size, "seed": seed, "device": device, "scene": str(scene or ""), "commit": harness()["commit"]}
        for m in measurements if again else ():
            (out / "measurements" / f"{m.id}.json").unlink(missing_ok=True)
        results = measure_all(measurements, Request(size, seed, device, made), out / "measurements", key, _say)
        started, finished = measured_from_to(results)
        report = {
            "format": FORMAT, "size": size, "seed": seed, "device": device, "started": started, "finished": finished,
            "command": command_line(), "harness": harness(), "environment": environment(device),
            "measurements": results,
        }  # fmt: skip
        return write_report(report, out)

    return speed_error


def write_report(report: dict[str, Any], out: Path) -> int:
    """Write the JSON and the page; return 1 if a measurement failed, else 0."""
    from spike4dgs.studies.speed_error.content import write_content

    check_schema(report, load_schema("spike4dgs.benchmark", "speed_error.schema.json"), "the report", "report this")
    write_json(out / "speed_error.json", report)
    write_content(out / "index.html", report)
    failed = [m["id"] for m in report["measurements"] if m["problem"]]
    _say(f"page: {out / 'index.html'}\nJSON: {out / 'speed_error.json'}")
    if failed:
        _say(f"failed, see the page: {', '.join(failed)}")
    return 1 if failed else 0


def _say(line: str) -> None:
    print(line, flush=True)
