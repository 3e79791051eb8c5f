"""The variants of the worlds by their number: what each may be used for."""

from __future__ import annotations

import re

PUBLIC_VARIANT = 0  # that of release 1, and of a command that names none
# The public benchmark's, three a world: no network may learn from them. 1 and 2 are not among them, because the
# included weights of Spk2ImgNet were trained on 1 and chosen on 2.
PUBLIC_VARIANTS = (PUBLIC_VARIANT, 3, 4)
# The others of 1 to 9 are kept for tests and for other networks' training. Of the rest the three first ones are never
# trained on and serve for scores of MSDI, and the first two of them for tuning, as the track dev-small.
HIDDEN_VARIANTS = (10, 11, 12)
DEVELOPMENT_VARIANTS = HIDDEN_VARIANTS[:2]
FIRST_TRAINING_VARIANT = 13
FIRST_SEASON_VARIANT = 9000  # from here on they are the maintainers', for hidden seasons: nobody may train on them


_MADE = re.compile(r"(?P<world>.+?)-\d+-(?:tiny|small|paper)(?:-.*)?")


def world_of(scene: str) -> str:
    """Return the world of a scene that has the name of a made one; any other scene is a world of its own.

    >>> world_of("car-3-small-realistic"), world_of("car-3")
    ('car', 'car-3')
    """
    made = _MADE.fullmatch(scene)
    return made["world"] if made else scene


def is_reserved(variant: object) -> bool:
    """Return whether a variant is kept for hidden seasons; a scene of no world has none."""
    return isinstance(variant, int) and variant >= FIRST_SEASON_VARIANT
