import json
import re
from pathlib import Path

from safetensors import safe_open

from spike4dgs.benchmark.variants import (
    DEVELOPMENT_VARIANTS,
    FIRST_SEASON_VARIANT,
    FIRST_TRAINING_VARIANT,
    HIDDEN_VARIANTS,
    PUBLIC_VARIANTS,
    is_reserved,
)

ROOT = Path(__file__).parents[2]
WEIGHTS = (
    "baselines/images/spk2img/spk2img-8.safetensors",
    "method/image_network/images.safetensors",
    "method/matching/matcher.safetensors",
    "method/msdi/msdi-small.safetensors",
)


def trained_on(weights: Path) -> list[str]:
    with safe_open(weights, "np") as file:
        cards = [json.loads(text) for text in file.metadata().values()]
    return [name for card in cards for name in card["trained_on"]]


def test_the_uses_of_variants_do_not_overlap() -> None:
    assert max(PUBLIC_VARIANTS) < min(HIDDEN_VARIANTS) <= max(HIDDEN_VARIANTS) < FIRST_TRAINING_VARIANT
    assert FIRST_TRAINING_VARIANT < FIRST_SEASON_VARIANT and set(DEVELOPMENT_VARIANTS) < set(HIDDEN_VARIANTS)


def test_no_included_network_has_seen_a_public_or_a_development_variant() -> None:
    """From the cards of the weights that the package holds: names such as car-1-small@REVISION."""
    kept = {*PUBLIC_VARIANTS, *DEVELOPMENT_VARIANTS}
    seen = [name for weights in WEIGHTS for name in trained_on(ROOT / weights)]
    assert len(seen) > 20
    assert not [name for name in seen if int(re.split("[-@]", name)[1]) in kept]


def test_only_variants_of_seasons_are_reserved() -> None:
    assert [is_reserved(v) for v in (0, 13, 8999, 9000, 10**9)] == [False, False, False, True, True]
    assert not is_reserved(None), "a recording is of no world"
