"""Training of MSDI at tiny size: it learns, resumes bit for bit, is scored honestly, and leaves its files behind."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from resumed import check_resumed, same_tensors
from toy_bursts import write_toy_shard
from toy_world import GAIN

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.files import sha256_file
from spike4dgs.benchmark.scene.training_bursts import BurstFacts, open_folder
from spike4dgs.cli.options import Compute
from spike4dgs.cli.train_msdi import train_msdi
from spike4dgs.method.msdi import TINY, Estimate, Msdi
from spike4dgs.method.msdi.evaluate import GROUPS, calibrate, evaluate, tfp
from spike4dgs.method.msdi.inputs import Sensors
from spike4dgs.method.msdi.losses import ALPHA
from spike4dgs.method.msdi.records import Curve, StartWeights, model_card
from spike4dgs.method.msdi.train import Run, Training, TrainingSettings, checkpoint_key, start_from
from spike4dgs.method.msdi.training_data import Batch, Bursts
from spike4dgs.method.msdi.weights import WEIGHTS, Card, load_network

FAST = TrainingSettings(steps=150, views=4, most_views=3, lr_points=4e-3, warm_up=10)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Bursts:
    folder = tmp_path_factory.mktemp("bursts")
    write_toy_shard(folder, 13, instants=1)
    return Bursts(open_folder(folder))


@pytest.fixture(scope="module")
def trained(data: Bursts) -> tuple[Training, list[float], list[float]]:
    training = Training(data, TINY, FAST, "cpu", seed=1)
    losses = [training.train_step() for _ in range(FAST.steps)]
    return training, [x.image_l1 for x in losses], [x.points for x in losses]


def test_random_weights_are_clearly_worse(data: Bursts, trained: tuple[Training, list[float], list[float]]) -> None:
    batches = data.fixed(1, 4, TINY.ticks)
    learned = evaluate(trained[0].network, batches, "cpu").measured
    random = evaluate(Training(data, TINY, FAST, "cpu", seed=5).network, batches, "cpu").measured
    assert learned["psnr_db"] > random["psnr_db"] + 3
    assert learned["point_error"] < 0.7 * random["point_error"]
    assert learned["point_error_median"] < 0.7 * random["point_error_median"]
    assert learned["calibration"] < 0.6 * random["calibration"]
    assert learned["rotation_deg"] < 15 and learned["posed"] == 1 and random["rotation_deg"] > 45


def test_a_resumed_training_gives_the_bits_of_one_that_never_stopped(data: Bursts, tmp_path: Path) -> None:
    check_resumed(lambda: Training(data, TINY, FAST, "cpu", seed=2), tmp_path / "c.safetensors")


def test_checkpoints_of_earlier_versions_are_resumed() -> None:
    """The key is that of the version whose settings had other names."""
    key = checkpoint_key(TrainingSettings(), "small", 0, None)
    assert key == "8d12cfd8bc72a85ee8cf98c88de92056ffe5b97400ac9f79191fd92c1ce9d67d"


def test_batches_have_a_steady_number_of_views(data: Bursts) -> None:
    training = Training(data, TINY, replace(FAST, views=8, most_views=8), "cpu", seed=0)
    seen = set()
    for step in range(30):
        samples, views = training.batch(step).spikes.shape[:2]
        assert samples == 8 // views
        seen.add(views)
    assert seen == set(range(2, 9))


def test_a_training_that_weights_began_does_not_see_their_batches_again(data: Bursts, tmp_path: Path) -> None:
    training = Training(data, TINY, FAST, "cpu", seed=0)
    first, fourth = training.batch(0), training.batch(3)
    Run(training, [], "key", tmp_path, StartWeights("earlier.safetensors", "2345", steps=3))
    np.testing.assert_array_equal(training.batch(0).rate, fourth.rate)
    assert first.rate.shape != fourth.rate.shape or not np.array_equal(first.rate, fourth.rate)


def test_a_step_without_a_finite_gradient_changes_nothing(data: Bursts, monkeypatch: pytest.MonkeyPatch) -> None:
    training = Training(data, TINY, FAST, "cpu", seed=3)
    before = {name: value.clone() for name, value in training.network.state_dict().items()}
    monkeypatch.setattr("spike4dgs.method.msdi.train.point_loss", lambda p, c, t: (c * float("inf")).sum())
    training.train_step()
    assert training.step == 1
    same_tensors(training.network.state_dict(), before)


# ---------------------------------------------------------------- scores


class Oracle(torch.nn.Module):
    """A network that returns the truth at another scale, plus `off` in one coordinate of all points of odd rows."""

    def __init__(self, batch: Batch, off: float = 0.0) -> None:
        super().__init__()
        points = torch.from_numpy(batch.points) * 2.5
        points[:, :, 1::2, :, 1] += off
        confidence = torch.full(points.shape[:-1], 50.0)
        confidence[:, :, 1::2] = 2.0
        self.answer = Estimate(points, confidence, torch.from_numpy(batch.rate))

    def forward(self, spikes: torch.Tensor, intrinsics: torch.Tensor | None, sensors: Sensors | None) -> Estimate:
        return self.answer

    def images(self, spikes: torch.Tensor) -> torch.Tensor:
        return self.answer.images.flatten(0, 1)


def test_the_truth_has_no_error(data: Bursts) -> None:
    batch = data.fixed(1, 5, TINY.ticks)[0]
    found = evaluate(Oracle(batch), [batch], "cpu").measured  # type: ignore[arg-type]
    assert found["psnr_db"] == 100 and found["psnr_dynamic_db"] == 100
    assert 5 < found["tfp_psnr_db"] < 40
    assert found["point_error"] < 1e-6 and found["rotation_deg"] < 0.05 and found["direction_deg"] < 0.2
    assert found["rra_5"] == found["rta_5"] == found["posed"] == 1


def test_errors_that_the_confidence_predicts_are_ranked(data: Bursts) -> None:
    batch = data.fixed(1, 4, TINY.ticks)[0]
    scores = evaluate(Oracle(batch, off=1.0), [batch], "cpu")  # type: ignore[arg-type]
    found = scores.measured
    assert found["confidence_rank"] > 0.8
    assert found["point_error_confident"] < 0.5 * found["point_error"]
    assert found["point_error"] > 0.02
    assert scores.calibration is not None
    np.testing.assert_allclose(scores.calibration[[0, -1], 0], [ALPHA / 50, ALPHA / 2], rtol=1e-5)


def test_calibration_groups_are_means_of_equal_parts() -> None:
    rng = np.random.default_rng(0)
    expected = rng.permutation(np.arange(1.0, 101.0))
    groups = calibrate(expected, 3 * expected)
    assert groups.shape == (GROUPS, 2)
    np.testing.assert_allclose(groups[:, 0], np.arange(5.5, 100, 10))
    np.testing.assert_allclose(groups[:, 1], 3 * groups[:, 0])


def test_tfp_is_the_mean_of_the_ticks_around_the_instant() -> None:
    spikes = np.zeros((2, 9, 3, 4), np.uint8)
    spikes[0, :8, 1] = 1  # all ticks of [instant - 4, instant + 4)
    spikes[1, 8] = 1  # beyond
    spikes[1, 2:4] = 1
    found = tfp(spikes)
    assert found.shape == (2, 3, 4)
    np.testing.assert_array_equal(found[0], np.array([0, 1, 0], np.float32)[:, None] * np.ones((3, 4)))
    np.testing.assert_array_equal(found[1], 0.25)


def test_curves_drop_rows_that_a_resumed_training_repeats(tmp_path: Path) -> None:
    curve = Curve(tmp_path / "c.csv", 0)
    for step in (50, 100, 150):
        curve.add(step, {"total": step / 7})
    curve.write()
    again = Curve(tmp_path / "c.csv", 100)
    assert [row["step"] for row in again.rows] == [50, 100]
    assert again.rows[1]["total"] == pytest.approx(100 / 7, rel=1e-6)
    again.add(150, {"total": 2.0, "psnr_db": 30.0})  # as soon as there are shards to score
    again.write()
    assert Curve(tmp_path / "c.csv", 150).rows == [*again.rows[:2], {"step": 150, "total": 2, "psnr_db": 30}]
    (tmp_path / "c.csv").write_text("step,total\n1,x\n")
    with pytest.raises(UserError, match="expected a table of numbers, found damaged text"):
        Curve(tmp_path / "c.csv", 100)


@pytest.mark.parametrize("views", [2, 4])
def test_a_step_has_no_more_views_than_are_asked_for(data: Bursts, views: int) -> None:
    training = Training(data, TINY, replace(FAST, views=views, most_views=8), "cpu", seed=0)
    drawn = [training.batch(step).spikes.shape[:2] for step in range(12)]
    assert max(samples * each for samples, each in drawn) <= views


def test_the_card_counts_variants_and_names_what_began_the_training() -> None:
    card = Card("tiny", 3, 0, ("car-13@0123", "car-13@4567", "car-14@89ab", "bird-13@cdef"), {})
    facts = [BurstFacts(*own, 0, 104, 64, 9, 6, 3, 32, GAIN, 5e4, 12) for own in (("car", 13), ("car", 14))]
    facts.append(replace(facts[0], world="bird", rigs=1, seed=7))
    text = model_card(card, FAST, "ef01", facts, StartWeights("earlier.safetensors", "2345"))
    assert "variants of each world: bird (1), car (2)." in text
    assert "Begun with the weights `earlier.safetensors`, sha256 `2345`." in text
    assert " --seed 0 --start earlier.safetensors`." in text
    settings = "--instants 3 --resting 12 --width 104 --height 64 --spp 32"
    assert f"`spike4dgs make-msdi-data car --variants 2 --rigs 6 {settings} --seed 0`" in text
    assert f"`spike4dgs make-msdi-data bird --variants 1 --rigs 1 {settings} --seed 7`" in text


# ---------------------------------------------------------------- command


def test_command_to_weights_and_card(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    folder, out = tmp_path / "data", tmp_path / "out"
    size = {"width": 24, "height": 16, "side": 2}
    write_toy_shard(folder, 10, instants=1, **size)  # hidden, and scored three times: random points take the longest
    for variant in (13, 14):
        write_toy_shard(folder, variant, **size)
    arguments = {"data": folder, "out": out, "config": "tiny", "steps": 3, "views": 4, "compute": Compute("cpu")}
    assert train_msdi(**arguments) == 0  # type: ignore[arg-type]
    printed = capsys.readouterr().out
    assert "4 bursts, tiny" in printed and "step 3/3, L1" in printed
    path = out / "msdi-tiny.safetensors"
    card = WEIGHTS.read_card(path)
    hashes = {f.facts.id: f.sha256[:16] for f in open_folder(folder)}
    assert card.trained_on == tuple(f"toy-{v}@{hashes[f'toy-{v}']}" for v in (13, 14))
    assert (card.config, card.steps) == ("tiny", 3) and 0 < card.measured["psnr_db"] < 40
    text = (out / "README.md").read_text()
    assert "variants of each world: toy (2)" in text and f"| {card.measured['point_error']:g} |" in text
    assert "`spike4dgs train-msdi --config tiny --steps 3 --views 4 --rate 0.0001 --seed 0`" in text
    assert (out / "curves.png").stat().st_size > 10_000 and (out / "calibration.png").stat().st_size > 5_000
    with open(out / "losses.csv", newline="") as f:
        rows = list(csv.DictReader(f))
    assert [row["step"] for row in rows] == ["3"]

    monkeypatch.setattr("spike4dgs.method.msdi.train.plot_curves", lambda *_: None)  # half of the time, once is enough
    before, scores = path.read_bytes(), (out / "scores.csv").read_text()
    path.unlink()
    (out / "README.md").unlink()
    assert train_msdi(**arguments) == 0  # type: ignore[arg-type]
    assert path.read_bytes() == before and (out / "README.md").read_text() == text  # done already, but for these
    assert (out / "scores.csv").read_text() == scores

    write_toy_shard(tmp_path / "more", 15, instants=1, **size)
    begun = {**arguments, "data": tmp_path / "more", "out": tmp_path / "begun", "start": path}
    assert train_msdi(**begun) == 0  # type: ignore[arg-type]
    text = (tmp_path / "begun/README.md").read_text()
    assert f"`{path.name}` of step 3, sha256 `{sha256_file(path)}`" in text
    assert "Measured" not in text and "calibration.png" not in text, "without hidden shards there are no scores"
    assert not (tmp_path / "begun/calibration.png").exists() and "\n\n## Training\n\n- Data" in text
    assert "Weights of step 6," in text and "- 3 steps of 4 views" in text
    seen = WEIGHTS.read_card(tmp_path / "begun/msdi-tiny.safetensors").trained_on
    assert set(seen) > set(card.trained_on) and any(name.startswith("toy-15@") for name in seen)

    network = Msdi(TINY)
    start_from(network, path)
    same_tensors(network.state_dict(), load_network(path, "cpu").state_dict())
    with pytest.raises(UserError, match="expected the tensors of Fast3R or DUSt3R, found others"):
        start_from(Msdi(replace(TINY, encoder_layers=1)), path)


def test_data_that_is_kept_for_tests_is_refused(tmp_path: Path) -> None:
    write_toy_shard(tmp_path, 11)
    with pytest.raises(UserError, match="expected shards to train on, found hidden variants only"):
        train_msdi(data=tmp_path, out=tmp_path / "out", config="tiny")
    write_toy_shard(tmp_path, 1)
    with pytest.raises(UserError, match="found toy-1; remove them: they are kept for tests"):
        train_msdi(data=tmp_path, out=tmp_path / "out", config="tiny")
    write_toy_shard(tmp_path, 9000)
    with pytest.raises(UserError, match="those from 13 to 8999, found toy-1, toy-9000; remove them"):
        train_msdi(data=tmp_path, out=tmp_path / "out", config="tiny")
    names = "paper, small, tiny, bottleneck, bottleneck-tiny, images, images-tiny, images-without-.*"
    with pytest.raises(UserError, match=f"--config: expected one of {names}, found 'large'"):
        train_msdi(data=tmp_path, out=tmp_path / "out", config="large")
    assert not (tmp_path / "out").exists()
