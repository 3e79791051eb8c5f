"""`fault-table`: what the imperfections of an array cost a fit."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import Positional

from spike4dgs.benchmark.method import DEFAULT_BUDGET
from spike4dgs.studies import faults


def fault_table(
    scene: Positional[Path],
    *,
    lens_scene: Path | None = None,
    methods: tuple[str, ...] = ("spike4dgs-x", "spk2img+stg"),
    out: Path = Path("runs/faults"),
    budget: str = DEFAULT_BUDGET,
    seed: int = 0,
    device: str = "auto",
) -> int:
    """Make captures of a scene worse on purpose, fit each, and tabulate the dB that a held-out camera loses.

    A killed run continues: give the same command again.

    Args:
        scene: A made scene with ground truth.
        lens_scene: The same scene made with `make-dataset --lens`, for the rows of lens distortion; its held-out camera
            is judged through its lens.
        methods: Methods by name.
        out: Folder for table.md, table.csv, table.json and table.png; captures and fits are kept there too.
        budget: quick, standard (4 times the steps), or a multiple of quick.
        seed: Seed of the imperfections and of the fits.
        device: auto, cpu or cuda.
    """
    faults.fault_table(scene, lens_scene, methods, out, budget, seed, device)
    print(f"table: {out}/{{table.md,table.csv,table.json,table.png}}")
    return 0
