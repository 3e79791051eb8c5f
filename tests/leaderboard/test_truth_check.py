from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dummy_methods import CountMethod, run
from scipy.ndimage import gaussian_filter
from submissions import board, enter, read, release_of

from spike4dgs.benchmark.files import sha256_file, write_text
from spike4dgs.benchmark.runs.record import write_record
from spike4dgs.benchmark.runs.score import score_predictions
from spike4dgs.benchmark.scene.images import read_exr, write_exr
from spike4dgs.benchmark.scene.manifest import write_manifest
from spike4dgs.benchmark.scene.scene import Scene, open_scene
from spike4dgs.leaderboard.truth_check import noise_ceiling_db, noise_share

NOISE = 0.004  # 48 dB
RNG = np.random.default_rng(0)
TEXTURE = 0.5 + 0.2 * RNG.random((120, 160))  # as fine as noise, and much stronger


def noisy(image: np.ndarray, sigma: float = NOISE) -> np.ndarray:
    return image + RNG.normal(0, sigma, image.shape)


TRUTH, FIRST, SECOND = (noisy(TEXTURE) for _ in range(3))


def test_the_ceiling_is_the_psnr_of_the_truths_noise() -> None:
    found = noise_ceiling_db(TRUTH, FIRST, SECOND)
    assert found == pytest.approx(-20 * np.log10(NOISE), abs=0.2)
    assert found == pytest.approx(-10 * np.log10(np.mean((TRUTH - TEXTURE) ** 2)), abs=0.2)
    assert noise_ceiling_db(TEXTURE, TEXTURE, TEXTURE) is None


@pytest.mark.parametrize(
    ("image", "share"),
    [
        (TRUTH, 1.0),
        (0.9 * TRUTH, 1.0),
        (noisy(TRUTH, 0.003), 1.0),
        (noisy(TRUTH, 0.02), 1.0),
        (0.5 * TRUTH + 0.5 * TEXTURE, 0.5),
        (TEXTURE, 0.0),
        (noisy(TEXTURE), 0.0),
        (noisy(TEXTURE, 0.03), 0.0),
        (gaussian_filter(TEXTURE, 1.0), 0.0),
        (0.8 * gaussian_filter(TEXTURE, 3.0), 0.0),
        (np.roll(TEXTURE, 1, axis=1), 0.0),
        (np.zeros_like(TEXTURE), 0.0),
    ],
)
def test_the_share_is_how_much_of_the_truths_noise_an_image_has(image: np.ndarray, share: float) -> None:
    found, error = noise_share(image, TRUTH, FIRST, SECOND)
    assert found is not None and error is not None
    assert abs(found - share) < 4 * error + 0.01
    assert error < 0.02 or np.std(image - TEXTURE) > 0.01


def predict(done: Path, name: str, image_of: Any) -> None:
    """A record and predictions of a program whose images are `image_of(scene, target)`."""
    scenes = [open_scene(done / s) for s in ("s0", "s1")]
    folder = Path(shutil.copytree(done / "out/predictions/rough", done / "out/predictions" / name))
    for scene in scenes:
        root = folder / scene.id
        for target in scene.targets:
            write_exr(root / f"{target.name}.exr", image_of(scene, target).astype(np.float32), 0.0)
        sums = [f"{sha256_file(root / f'{t.name}.exr')}  {t.name}.exr\n" for t in scene.targets]
        write_text(root / "SHA256SUMS", "".join(sorted(sums, key=lambda line: line[66:])))
        info = root / "prediction.json"
        info.write_text(info.read_text().replace('"rough"', f'"{name}"'))
    write_record(done / f"out/results/{name}.json", score_predictions(folder, scenes))


def second(scene: Scene) -> Any:
    """Renderings with other noise of a target whose truth has noise; the small scenes' truth without its noise."""
    clean = np.asarray(read_exr(scene.root / f"clean-{scene.targets[0].camera}.exr"), np.float64)
    rng = np.random.default_rng(5)
    return scene.targets[0], *(clean + rng.normal(0, NOISE, clean.shape) for _ in range(2))


def with_noise(done: Path) -> None:
    """Give the run's scenes a truth with noise, and keep one without beside them."""
    for name in ("s0", "s1"):
        scene = open_scene(done / name)
        for i, target in enumerate(scene.targets):
            path, image = scene.root / f"images/{target.name}.exr", scene.ground_truth(target)
            if i == 0:
                write_exr(scene.root / f"clean-{target.camera}.exr", image, 0.0)
            write_exr(path, noisy(image).astype(np.float32), 0.0)
        write_manifest(scene.root)
    shutil.rmtree(done / "out")
    run(done / "out", [done / "s0", done / "s1"], CountMethod("tfp+4dgs"), CountMethod("rough", steps=1))


def enter_checked(done: Path, name: str) -> dict[str, Any]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("spike4dgs.generators.truth.second_renderings", second)
        enter(done, name)
    rows = {r["method"]: r for r in board(done, "leaderboard")["boards"][0]["rows"]}
    return dict(rows[name])


def test_the_truth_is_flagged_and_honest_methods_are_not(done: Path, monkeypatch: Any, said: Any) -> None:
    with_noise(done)
    release_of(done, monkeypatch)
    truth = Scene.ground_truth
    rng = np.random.default_rng(1)
    predict(done, "copied", truth)
    predict(done, "disturbed", lambda s, t: truth(s, t) + rng.normal(0, 0.003, truth(s, t).shape))
    predict(done, "one", lambda s, t: truth(s, t) + 0.05 * (t.tick != 40))
    some = np.arange(24 * 40).reshape(24, 40) % 2
    predict(done, "half", lambda s, t: truth(s, t) + 0.05 * ((t.tick != 40) | some))
    predict(done, "pixels", lambda s, t: np.where(rng.random((24, 40)) < 0.3, truth(s, t), 0.7))
    for name in ("tfp+4dgs", "rough"):
        row = enter_checked(done, name)
        assert row["flags"] == [] and row["rank"] is not None
    scenes = "(pattern-0, pattern-1)"
    assert f"equals truth {scenes}" in enter_checked(done, "copied")["flags"]
    for name in ("one", "half"):  # of an image
        assert enter_checked(done, name)["flags"][0] == f"equals truth {scenes}"
    assert enter_checked(done, "pixels")["flags"] == [f"equals truth {scenes}"]
    row = enter_checked(done, "disturbed")
    assert row["rank"] is None and f"carries the truth's noise {scenes}" in row["flags"]
    assert "disturbed: re-scored, not ranked (carries the truth's noise (pattern-0, pattern-1)" in said()
    assert [r["rank"] for r in board(done, "leaderboard")["boards"][0]["rows"]] == [1, 2, *[None] * 5]
    entry = read(next((done / "board/entries").glob("*/disturbed.json")))
    for check in entry["verification"]["truth"].values():
        assert check["noise_share"] == pytest.approx(1, abs=0.1)
        assert check["ceiling_db"] == pytest.approx(48, abs=0.6)
        assert check["target"] == open_scene(done / "s0").targets[0].name


def test_without_second_renderings_the_releases_ceilings_hold(done: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with_noise(done)
    release_of(done, monkeypatch, {"pattern-1": 48.0})
    rng = np.random.default_rng(1)
    predict(done, "disturbed", lambda s, t: s.ground_truth(t) + rng.normal(0, 0.003, (24, 40)))
    monkeypatch.setitem(globals(), "second", lambda scene: None)
    (flag,) = enter_checked(done, "disturbed")["flags"]
    assert flag.startswith("above the noise ceiling (pattern-1 has 50.") and flag.endswith(" of 48.0 dB)")
