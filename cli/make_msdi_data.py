"""`make-msdi-data`: training bursts of many variants of the worlds, seen by many rigs."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.cli.options import RENDERERS, Renderers, check_names
from spike4dgs.generators.msdi_data.make_msdi_data import MakeBursts, all_worlds, make_shards
from spike4dgs.generators.rendering.mitsuba_variant import choose_device

DEFAULTS = MakeBursts()


def make_msdi_data(
    worlds: Positional[tuple[str, ...]] = (),
    *,
    out: Path = Path("data/msdi"),
    variants: int = 40,
    bursts: OmitArgPrefixes[MakeBursts] = DEFAULTS,
    renderers: OmitArgPrefixes[Renderers] = RENDERERS,
) -> int:
    """Render training data for MSDI: shards OUT/WORLD-VARIANT.safetensors, including the three hidden variants.

    Existing shards are kept, so a killed run resumes and a larger --variants adds shards. Equal arguments give equal
    bytes, with any number of workers. Variants 0 to 9 of the worlds are never rendered.

    Args:
        worlds: Names of worlds; if left out, all of the benchmark and those for training only.
        out: Folder for the shards.
        variants: Number of training variants of each world.
    """
    known = all_worlds()
    check_names("worlds", worlds, known)
    choose_device(renderers.device)
    make_shards(out, worlds or known, variants, bursts, renderers.workers, renderers.scheduler)
    return 0
