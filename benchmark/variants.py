"""The variants of the worlds by their number: what each may be used for."""

from __future__ import annotations

PUBLIC_VARIANT = 0  # the public benchmark's: no network may learn from it
# 1 to 9 are kept for tests and for other networks' training. Of the rest the three first ones are never trained on and
# serve for scores of MSDI.
HIDDEN_VARIANTS = (10, 11, 12)
FIRST_TRAINING_VARIANT = 13
FIRST_SEASON_VARIANT = 9000  # from here on they are the maintainers', for hidden seasons: nobody may train on them


def is_reserved(variant: object) -> bool:
    """Return whether a variant is kept for hidden seasons; a scene of no world has none."""
    return isinstance(variant, int) and variant >= FIRST_SEASON_VARIANT
