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

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.runs.record import dataset_means
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.cli.season import check, reveal
from spike4dgs.generators.make_dataset import SceneSettings, make_dataset
from spike4dgs.leaderboard.season.results import write_table
from spike4dgs.leaderboard.season.season_file import OPENING_NAME, draw_opening, read_opening
from spike4dgs.leaderboard.verify import Rescored

SCENE = "car-9003-tiny"


@pytest.fixture(scope="module")
def over(scored_once: Made, tmp_path_factory: pytest.TempPathFactory) -> Made:
    """A season that is revealed, which no test changes; in `scenes` are its scenes as folders and tars."""
    root = tmp_path_factory.mktemp("over")
    shutil.copytree(scored_once.seasons, root / "seasons")
    assert reveal(NUMBER, secret=scored_once.secret, seasons=root / "seasons") == 0
    shutil.copytree(scored_once.secret / "scenes", root / "scenes")
    for pack in (scored_once.secret / "packs").iterdir():
        shutil.copy(pack, root / "scenes")
    (root / "runs").symlink_to(scored_once.root / "runs")
    return Made(root)


def checked(made: Made, **options: Any) -> int:
    given = {"scenes": made.root / "scenes", "predictions": made.root / "runs/predictions", **options}
    return check(NUMBER, seasons=made.seasons, **given)


def test_all_is_right(over: Made, capsys: pytest.CaptureFixture[str]) -> None:
    capsys.readouterr()
    assert checked(over) == 0
    shown = capsys.readouterr()
    assert not shown.err and "not checked" not in shown.out
    assert len(shown.out.splitlines()) == shown.out.count("ok: ") == 2 + 2 * 3 + 2


def test_metrics_that_were_not_computed_again_are_named(over: Made, monkeypatch: pytest.MonkeyPatch, said: Any) -> None:
    """For lack of weights, or because other weights are here."""
    found = Rescored(frozenset({"metaiqa", "lpips"}), {})
    monkeypatch.setattr("spike4dgs.leaderboard.season.check.verify_record", lambda *_, **__: found)
    said()
    assert checked(over) == 0
    assert "follow from its predictions; as claimed, not computed again: lpips, metaiqa\n" in said()


def test_public_files_alone_say_what_remains(over: Made, said: Any) -> None:
    said()
    assert checked(over, scenes=None, predictions=None) == 0
    out = said()
    assert out.count("ok: ") == 2 and out.count("not checked: ") == 8
    for seed in read_opening(over.public / OPENING_NAME).scenes:
        way = f"--profile tiny --variant 9003 --rendering paths --seed {seed.seed} --out"
        assert f"spike4dgs make-dataset {seed.world} {way}" in out


def test_tars_alone_are_checked(over: Made, tmp_path: Path, said: Any) -> None:
    for pack in (over.root / "scenes").glob("*.tar"):
        shutil.copy(pack, tmp_path)
    said()
    assert checked(over, scenes=tmp_path) == 0
    out = said()
    assert out.count("is the tar committed to") == 4 and out.count("not checked: ") == 4


def test_season_0_is_revealed_and_right(said: Any) -> None:
    seasons = Path(__file__).resolve().parents[3] / "leaderboard/seasons"
    assert check(0, seasons=seasons) == 0
    out = said()
    assert "ok: the seeds of 2 scenes" in out and "ok: 3 results" in out


@pytest.mark.parametrize("option", ["scenes", "predictions"])
def test_a_folder_that_is_not_there_is_not_passed_over(once: Made, tmp_path: Path, option: str) -> None:
    with pytest.raises(UserError, match=f"--{option}: expected a folder, found .*typo, which is none"):
        check(NUMBER, seasons=once.seasons, **{option: tmp_path / "typo"})


def test_before_the_reveal_nothing_secret_is_shown(once: Made, said: Any) -> None:
    assert checked(once, scenes=None) == 0
    out = said()
    assert once.season.opening_sha256 in out and "ok: " not in out
    assert not [s for s in read_opening(once.secret / OPENING_NAME).scenes if s.seed in out]


def test_a_scene_made_again_from_its_seed_is_the_committed_one(
    over: Made, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, said: Any
) -> None:
    render_fakes(monkeypatch)
    seed = read_opening(over.public / OPENING_NAME).scenes[0]
    settings = SceneSettings(seed.profile, int(seed.seed), seed.variant, rendering=seed.rendering)
    make_dataset([settings.job(seed.world)], tmp_path / "again")
    assert checked(over, scenes=tmp_path / "again", predictions=None) == 0
    assert said().count("is the scene committed to") == 1
    make_dataset([SceneSettings("tiny", int(seed.seed) ^ 1, 9003).job("car")], tmp_path / "wrong")
    assert checked(over, scenes=tmp_path / "wrong", predictions=None) == 2
    assert "render other bytes" in said()


def changed(name: str, change: Callable[[Any], object]) -> Callable[[Made], None]:
    """Change a public JSON file of the season."""
    return lambda over: edit_json(over.public / name, change)


def other_opening(over: Made) -> None:
    (over.public / OPENING_NAME).write_text(draw_opening(NUMBER, ("car", "turntable"), "tiny").text)


def stream(manifest: bool) -> Callable[[Made], None]:
    """Change a spike, and perhaps the manifest with it."""

    def forge(over: Made) -> None:
        flip_bit(over.root / "scenes" / SCENE / "spikes/cam_04.dat", 7)
        if manifest:
            write_manifest(over.root / "scenes" / SCENE)

    return forge


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


def longer(name: str) -> Callable[[Made], None]:
    def forge(over: Made) -> None:
        with open(over.root / "scenes" / name, "ab") as file:
            file.write(b"0")

    return forge


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


def predictions(over: Made) -> None:
    folder = over.root / "runs/predictions/counts"
    shutil.rmtree(folder)
    shutil.copytree(over.root / "runs/predictions/rough", folder)


COUNTS = "results/counts.json"
other_scenes = changed(COUNTS, lambda d: d["record"]["dataset"]["scenes"].update({SCENE: "0" * 64}))
other_training = changed("season.json", lambda d: d["scenes"][0].update(training_revision="0" * 64))
# What is changed, its folder, and what the check then says. It gets no more of the season than finds the change.
FORGED: dict[str, tuple[Callable[[Made], None], str, str]] = {
    "seed": (changed(OPENING_NAME, lambda d: d["scenes"][0].update(seed="1")), "seasons", "as committed"),
    "salt": (changed(OPENING_NAME, lambda d: d.update(salt="0" * 64)), "seasons", "as committed"),
    "other opening": (other_opening, "seasons", "as committed"),
    "world": (changed("season.json", lambda d: d["scenes"][0].update(world="van")), "seasons", "as in season.json"),
    "code": (changed("season.json", lambda d: d["harness"].update(commit="0" * 40)), "seasons", "as in season.json"),
    "stream": (stream(manifest=False), "scenes", "cam_04.dat: expected sha256"),
    "stream and manifest": (stream(manifest=True), "scenes", "expected revision"),
    "truth": (truth_behind_an_honest_manifest, "scenes", "the manifest claims another content"),
    "source's seed": (source_seed, "scenes", "as revealed"),
    "training part": (other_training, "scenes", "expected a training part of revision 0000"),
    "tar": (longer(f"{SCENE}.tar"), "scenes", f"{SCENE}.tar: expected sha256"),
    "training tar": (longer(f"{SCENE}-training.tar"), "scenes", f"{SCENE}-training.tar: expected sha256"),
    "value": (value, "runs", "as computed from the files"),
    "mean": (changed(COUNTS, lambda d: d["record"]["mean"].update(psnr=60.0)), "seasons", "the mean of its parts"),
    "other scenes": (other_scenes, "seasons", "expected scores of the committed"),
    "table": (table, "seasons", "expected the table of the results"),
    "missing row": (lambda over: (over.public / "results/rough.json").unlink(), "seasons", "expected the table of"),
    "predictions": (predictions, "runs", "expected predictions"),
}


@pytest.mark.parametrize(("forge", "folder", "message"), FORGED.values(), ids=FORGED)
def test_every_forged_part_is_caught(
    forge: Any, folder: str, message: str, over: Made, tmp_path: Path, said: Any
) -> None:
    for name in ("seasons", "scenes", "runs"):  # a forgery changes its folder and the public files alone
        if name in ("seasons", folder):
            shutil.copytree(over.root / name, tmp_path / name)
        else:
            (tmp_path / name).symlink_to(over.root / name)
    forge(Made(tmp_path))
    said()
    needless: dict[str, Any] = {"seasons": {"scenes": None, "predictions": None}, "scenes": {"predictions": None}}
    assert checked(Made(tmp_path), **needless.get(folder, {})) == 2
    assert message in said()
