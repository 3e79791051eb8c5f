from __future__ import annotations

import shutil
from datetime import UTC, datetime, timedelta

import pytest
from changes import edit_json
from made_season import NUMBER, Made

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.cli.season import publish, reveal
from spike4dgs.leaderboard.season.season_file import OPENING_NAME, draw_opening, write_secret


def closing(made: Made, days: int) -> None:
    day = (datetime.now(UTC) + timedelta(days=days)).strftime("%Y-%m-%d")
    edit_json(made.public / "season.json", lambda season: season.update(closes=day))


def test_the_revealed_file_is_what_was_committed_to(scored: Made) -> None:
    closing(scored, -1)
    assert reveal(NUMBER, secret=scored.secret, seasons=scored.seasons) == 0
    assert (scored.public / OPENING_NAME).read_bytes() == (scored.secret / OPENING_NAME).read_bytes()
    assert sha256_file(scored.public / OPENING_NAME) == scored.season.opening_sha256


def test_nothing_is_revealed_before_scores(once: Made) -> None:
    with pytest.raises(UserError, match="expected results, found none; score the submissions first"):
        reveal(NUMBER, secret=once.secret, seasons=once.seasons)
    assert not (once.public / OPENING_NAME).exists()


@pytest.mark.parametrize("days", [0, 3])
def test_nothing_is_revealed_before_the_closing_day_is_over(days: int, scored: Made) -> None:
    closing(scored, days)
    with pytest.raises(UserError, match="expected a day after"):
        reveal(NUMBER, secret=scored.secret, seasons=scored.seasons)
    assert not (scored.public / OPENING_NAME).exists()


def test_another_secret_is_not_revealed(scored: Made) -> None:
    write_secret(scored.secret, draw_opening(NUMBER, ("car", "turntable"), "tiny"))
    with pytest.raises(UserError, match="as committed"):
        reveal(NUMBER, secret=scored.secret, seasons=scored.seasons)


def test_before_the_reveal_only_training_parts_are_published(scored: Made) -> None:
    first, later = scored.root / "first", scored.root / "later"
    assert publish(NUMBER, secret=scored.secret, seasons=scored.seasons, out=first) == 0
    assert sorted(p.name for p in first.iterdir()) == ["car-9003-tiny-training.tar", "turntable-9003-tiny-training.tar"]
    reveal(NUMBER, secret=scored.secret, seasons=scored.seasons)
    assert publish(NUMBER, secret=scored.secret, seasons=scored.seasons, out=later) == 0
    packs = {p.name: sha256_file(p) for p in later.iterdir()}
    expected = {f"{s.id}.tar": s.pack_sha256 for s in scored.season.scenes}
    expected |= {f"{s.id}-training.tar": s.training_pack_sha256 for s in scored.season.scenes}
    assert packs == expected


def test_a_pack_that_was_not_committed_to_is_not_published(made: Made) -> None:
    """A mix-up of files would publish the truth."""
    packs = made.secret / "packs"
    shutil.copyfile(packs / "car-9003-tiny.tar", packs / "car-9003-tiny-training.tar")
    with pytest.raises(UserError, match="expected the committed sha256"):
        publish(NUMBER, secret=made.secret, seasons=made.seasons, out=made.root / "out")
    assert not (made.root / "out").exists()
