from __future__ import annotations

import hashlib
import json
import stat
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.leaderboard.season.season_file import OPENING_NAME, Opening, draw_opening, read_opening, write_secret

OPENING = draw_opening(3, ("car", "turntable"), "tiny")
TEXT = OPENING.text.encode()


def test_the_commitment_is_the_hash_of_the_file(tmp_path: Path) -> None:
    write_secret(tmp_path / "secret", OPENING)
    path = tmp_path / "secret" / OPENING_NAME
    assert hashlib.sha256(path.read_bytes()).hexdigest() == OPENING.sha256
    assert read_opening(path, OPENING.sha256) == OPENING
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700


def test_secrets_cannot_be_guessed() -> None:
    """Salts of 256 bits; seeds fill 128 bits and are new each time. A set bit lacks in 200 draws by 2^-200."""
    drawn = [draw_opening(0, ("car", "van"), "small") for _ in range(100)]
    assert {len(bytes.fromhex(o.salt)) for o in drawn} == {32} and len({o.salt for o in drawn}) == 100
    seeds = [int(s.seed) for o in drawn for s in o.scenes]
    assert len(set(seeds)) == 200 and max(seeds) < 2**128
    some, every = 0, 2**128 - 1
    for seed in seeds:
        some, every = some | seed, every & seed
    assert some == 2**128 - 1 and every == 0, "every bit is drawn"


def test_the_commitment_depends_on_everything_in_it() -> None:
    data = json.loads(OPENING.text)
    others = [OPENING.text]
    for key in ("season", "salt", "harness"):
        others.append(json.dumps({k: v for k, v in data.items() if k != key}))
    assert len({hashlib.sha256(o.encode()).hexdigest() for o in others}) == 4
    assert OPENING.salt in OPENING.text and all(s.seed in OPENING.text for s in OPENING.scenes)


def test_a_rendering_by_whole_paths_is_not_named_as_in_season_0(tmp_path: Path) -> None:
    paths = draw_opening(3, ("car",), "tiny", "paths")
    write_secret(tmp_path, paths)
    assert "rendering" not in paths.text and OPENING.text.count('"rendering": "split"') == 2
    assert read_opening(tmp_path / OPENING_NAME, paths.sha256) == paths


@given(st.integers(0, len(TEXT)), st.sampled_from([0, 1, 1, 1]), st.binary(min_size=1, max_size=3))
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_changed_or_added_byte_is_refused(tmp_path: Path, position: int, gone: int, more: bytes) -> None:
    changed = TEXT[:position] + more + TEXT[position + gone :]
    (tmp_path / OPENING_NAME).write_bytes(changed)
    if changed == TEXT:
        assert read_opening(tmp_path / OPENING_NAME, OPENING.sha256) == OPENING
    else:
        with pytest.raises(UserError):
            read_opening(tmp_path / OPENING_NAME, OPENING.sha256)


@pytest.mark.parametrize(
    "other",
    [
        json.dumps(json.loads(OPENING.text)),
        OPENING.text.replace('"season": 3', '"season": 4,\n  "season": 3'),
        OPENING.text + "\n",
    ],
)
def test_a_text_with_two_meanings_cannot_be_committed_to(other: str, tmp_path: Path) -> None:
    """Even its own hash does not open a text of another form: a reader may take the first of two equal keys."""
    assert other != OPENING.text
    (tmp_path / OPENING_NAME).write_text(other)
    with pytest.raises(UserError):
        read_opening(tmp_path / OPENING_NAME, hashlib.sha256(other.encode()).hexdigest())


@pytest.mark.parametrize(
    ("change", "message"),
    [({"salt": "ab" * 31}, "at salt"), ({"scenes": ()}, "at scenes"), ({"season": -1}, "at season")],
)
def test_a_weak_opening_is_refused(change: dict[str, object], message: str, tmp_path: Path) -> None:
    weak = Opening(**{**vars(OPENING), **change})  # type: ignore[arg-type]
    (tmp_path / OPENING_NAME).write_text(weak.text)
    with pytest.raises(UserError, match=message):
        read_opening(tmp_path / OPENING_NAME)
