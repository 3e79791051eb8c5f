from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from changes import edit_json, flip_bit
from fake_renderer import render_fakes
from made_season import NUMBER, Made

from spike4dgs.benchmark.runs.record import dataset_means
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.cli.season import check, reveal
from spike4dgs.generators.make_dataset import SceneSettings, make_dataset
from spike4dgs.leaderboard.season.results import write_table
from spike4dgs.leaderboard.season.season_file import OPENING_NAME, draw_opening, read_opening

SCENE = "car-9003-tiny"


@pytest.fixture
def over(scored: Made) -> Made:
    """A season that is revealed; in `scenes` are its scenes as folders and tars."""
    assert reveal(NUMBER, secret=scored.secret, seasons=scored.seasons) == 0
    shutil.copytree(scored.secret / "scenes", scored.root / "scenes")
    for pack in (scored.secret / "packs").iterdir():
        shutil.copy(pack, scored.root / "scenes")
    return scored


def checked(made: Made, **options: Any) -> int:
    given = {"scenes": made.root / "scenes", "predictions": made.root / "runs/predictions", **options}
    return check(NUMBER, seasons=made.seasons, **given)


def test_all_is_right(over: Made, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert checked(over) == 0
    shown = capsys.readouterr()
    assert not shown.err and "not checked" not in shown.out
    assert len(shown.out.splitlines()) == shown.out.count("ok: ") == 2 + 2 * 2 + 2


def test_public_files_alone_say_what_remains(over: Made, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert checked(over, scenes=None, predictions=None) == 0
    out = capsys.readouterr().out
    assert out.count("ok: ") == 2 and out.count("not checked: ") == 6
    for seed in read_opening(over.public / OPENING_NAME).scenes:
        way = f"--profile tiny --variant 9003 --rendering paths --seed {seed.seed} --out"
        assert f"spike4dgs make-dataset {seed.world} {way}" in out


def test_season_0_is_revealed_and_right(capsys: pytest.CaptureFixture[str]) -> None:
    seasons = Path(__file__).resolve().parents[3] / "leaderboard/seasons"
    assert check(0, seasons=seasons) == 0
    out = capsys.readouterr().out
    assert "ok: the seeds of 2 scenes" in out and "ok: 3 results" in out


def test_before_the_reveal_nothing_secret_is_shown(made: Made, capsys: pytest.CaptureFixture[str]) -> None:
    assert checked(made, scenes=None) == 0
    out = capsys.readouterr().out
    assert made.season.opening_sha256 in out and "ok: " not in out
    assert not [s for s in read_opening(made.secret / OPENING_NAME).scenes if s.seed in out]


def test_a_scene_made_again_from_its_seed_is_the_committed_one(
    over: Made, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    render_fakes(monkeypatch)
    for seed in read_opening(over.public / OPENING_NAME).scenes:
        settings = SceneSettings(seed.profile, int(seed.seed), seed.variant, rendering=seed.rendering)
        make_dataset([settings.job(seed.world)], over.root / "again")
    assert checked(over, scenes=over.root / "again") == 0
    assert capsys.readouterr().out.count("is the scene committed to") == 2
    make_dataset([SceneSettings("tiny", int(seed.seed) ^ 1, 9003).job("car")], over.root / "wrong")
    assert checked(over, scenes=over.root / "wrong", predictions=None) == 2
    assert "render other bytes" in capsys.readouterr().err


def changed(name: str, change: Callable[[Any], object]) -> Callable[[Made], None]:
    """Change a public JSON file of the season."""
    return lambda over: edit_json(over.public / name, change)


def other_opening(over: Made) -> None:
    (over.public / OPENING_NAME).write_text(draw_opening(NUMBER, ("car", "turntable"), "tiny").text)


def stream(over: Made) -> None:
    flip_bit(over.root / "scenes" / SCENE / "spikes/cam_04.dat", 7)


def stream_and_manifest(over: Made) -> None:
    stream(over)
    write_manifest(over.root / "scenes" / SCENE)


def truth_behind_an_honest_manifest(over: Made) -> None:
    """Another image, whose entry in the manifest has the right content, so that the revision is the committed one."""
    scene = over.root / "scenes" / SCENE
    before = json.loads((scene / "manifest.json").read_text())["files"]
    shutil.copyfile(scene / "images/cam_04/000040.exr", scene / "images/cam_04/000020.exr")
    write_manifest(scene)
    name = "images/cam_04/000020.exr"
    edit_json(scene / "manifest.json", lambda d: d["files"][name].update(content=before[name]["content"]))


def source_seed(over: Made) -> None:
    """The revision is that of the content, so the seed that scene.json states is checked on its own."""
    edit_json(over.root / "scenes" / SCENE / "scene.json", lambda d: d["source"].update(seed="5"))
    write_manifest(over.root / "scenes" / SCENE)


def tar(over: Made) -> None:
    with open(over.root / "scenes" / f"{SCENE}.tar", "ab") as file:
        file.write(b"0")


def value(over: Made) -> None:
    """One PSNR a little higher, and all means with it."""

    def raise_one(data: Any) -> None:
        cell = data["record"]["scenes"][SCENE]
        image = next(iter(cell["per_image"].values()))
        image["psnr"] += 0.3
        cell["metrics"]["psnr"] += 0.3 / len(cell["per_image"])
        data["record"]["mean"] = dataset_means(data["record"]["scenes"])

    edit_json(over.public / "results/counts.json", raise_one)
    write_table(over.seasons, over.season)


def table(over: Made) -> None:
    path = over.public / "table.md"
    path.write_text(path.read_text().replace("counts", "others"))


def missing_row(over: Made) -> None:
    (over.public / "results/rough.json").unlink()


def predictions(over: Made) -> None:
    folder = over.root / "runs/predictions/counts"
    shutil.rmtree(folder)
    shutil.copytree(over.root / "runs/predictions/rough", folder)


COUNTS = "results/counts.json"
FORGED: dict[str, tuple[Callable[[Made], None], str]] = {
    "seed": (changed(OPENING_NAME, lambda d: d["scenes"][0].update(seed="1")), "as committed"),
    "salt": (changed(OPENING_NAME, lambda d: d.update(salt="0" * 64)), "as committed"),
    "other opening": (other_opening, "as committed"),
    "world": (changed("season.json", lambda d: d["scenes"][0].update(world="van")), "as in season.json"),
    "code": (changed("season.json", lambda d: d["harness"].update(commit="0" * 40)), "as in season.json"),
    "stream": (stream, "cam_04.dat: expected sha256"),
    "stream and manifest": (stream_and_manifest, "expected revision"),
    "truth": (truth_behind_an_honest_manifest, "the manifest claims another content"),
    "source's seed": (source_seed, "as revealed"),
    "training part": (
        changed("season.json", lambda d: d["scenes"][0].update(training_revision="0" * 64)),
        "expected a training part of revision 0000",
    ),
    "tar": (tar, f"{SCENE}.tar: expected sha256"),
    "value": (value, "as computed from the files"),
    "mean": (changed(COUNTS, lambda d: d["record"]["mean"].update(psnr=60.0)), "the mean of its parts"),
    "other scenes": (
        changed(COUNTS, lambda d: d["record"]["dataset"]["scenes"].update({SCENE: "0" * 64})),
        "expected scores of the committed",
    ),
    "table": (table, "expected the table of the results"),
    "missing row": (missing_row, "expected the table of the results"),
    "predictions": (predictions, "expected predictions"),
}


@pytest.mark.parametrize(("forge", "message"), FORGED.values(), ids=FORGED)
def test_every_forged_part_is_caught(
    forge: Callable[[Made], None], message: str, over: Made, capsys: pytest.CaptureFixture[str]
) -> None:
    forge(over)
    capsys.readouterr()
    assert checked(over) == 2
    assert message in capsys.readouterr().err
