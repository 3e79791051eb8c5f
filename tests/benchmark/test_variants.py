from __future__ import annotations

from spike4dgs.benchmark.variants import (
    FIRST_SEASON_VARIANT,
    FIRST_TRAINING_VARIANT,
    HIDDEN_VARIANTS,
    PUBLIC_VARIANT,
    is_reserved,
)


def test_the_uses_of_variants_do_not_overlap() -> None:
    assert PUBLIC_VARIANT < min(HIDDEN_VARIANTS) <= max(HIDDEN_VARIANTS) < FIRST_TRAINING_VARIANT < FIRST_SEASON_VARIANT


def test_only_variants_of_seasons_are_reserved() -> None:
    assert [is_reserved(v) for v in (0, 13, 8999, 9000, 10**9)] == [False, False, False, True, True]
    assert not is_reserved(None), "a recording is of no world"
