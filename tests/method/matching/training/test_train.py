"""Data and training of the matching network: inputs, conditions, losses that fall, and runs that go on bit by bit."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from resumed import same_tensors
from safetensors.torch import load_file
from toy_bursts import toy_burst, write_toy_shard
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.training_bursts import open_bursts
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.checkpoint import load_checkpoint
from spike4dgs.method.matching.config import TINY, MatcherTraining
from spike4dgs.method.matching.training.data import at_light, draw, drawn, record, seen_by_network
from spike4dgs.method.matching.training.train import MatchTraining, run, training_key
from spike4dgs.method.matching.weights import WEIGHTS
from spike4dgs.method.matching.window_inputs import window_inputs

SETTINGS = MatcherTraining(samples=1, views=2, warm_up=5, hold=100)


def test_inputs_of_constant_light_do_not_depend_on_its_strength() -> None:
    ticks = np.arange(400)
    images = []
    for rate in (0.8, 0.2):
        bright, dim = (np.diff(np.floor(ticks * r), prepend=0.0) for r in (rate, rate / 4))
        spikes = np.stack([bright, dim, bright, dim], 1).reshape(400, 2, 2)
        images.append(window_inputs(SpikeStream(pack(spikes), 2, 2, 20_000.0), 200))
    # A pixel of the rate r among r and r / 4 has the root of 1.6 means, the other half of it.
    expected = np.sqrt([1.6, 0.4]) - 1
    for image in images:
        np.testing.assert_allclose(image[0], [expected, expected], atol=0.03)
        np.testing.assert_allclose(image[3], [expected, expected], atol=0.06)
        np.testing.assert_allclose(image[1], np.log2(400) / 8, atol=1e-6)


def test_known_sensors_are_taken_out_of_the_inputs() -> None:
    rng = np.random.default_rng(0)
    burst = toy_burst(ToyWorld(width=32, height=24), 0.4)
    still = replace(burst, keys=np.full_like(burst.keys, 0.5), moving=np.zeros_like(burst.moving))
    found = {}
    for known in (True, False):
        under = at_light(1.0, known, 400)
        found[known] = seen_by_network(still, record(still, 0.6, 5e4, under, rng), under)
    assert found[True][:, 0].std() < 0.5 * found[False][:, 0].std()


def test_conditions_are_within_their_ranges() -> None:
    rng = np.random.default_rng(0)
    settings = MatcherTraining()
    moving = [drawn(True, settings, rng) for _ in range(200)]
    still = [drawn(False, settings, rng) for _ in range(200)]
    assert {d.ticks for d in moving} == {41} and {d.instant for d in moving} == {20}
    assert max(d.ticks for d in still) > 300 and min(d.ticks for d in still) < 60
    assert all(10 <= d.instant < d.ticks - 10 for d in still)
    lights = [d.light for d in moving]
    assert 1 / 16 <= min(lights) < 0.08 and 0.8 < max(lights) <= 1
    assert 0.2 < np.mean([not d.known for d in still]) < 0.4


def test_longer_clips_of_a_burst_at_rest_have_its_rate() -> None:
    burst = toy_burst(ToyWorld(width=32, height=24), 0.4)
    still = replace(burst, keys=np.repeat(burst.keys[:1], 3, axis=0), moving=np.zeros_like(burst.moving))
    under = at_light(0.5, True, 400)
    stream = record(still, 0.6, np.inf, under, np.random.default_rng(0))[0]
    expected = still.keys[0, 0] * 0.3 * still.gain[0] + still.dark[0]
    assert stream.n_ticks == 400
    assert np.abs(stream.counts(0, 400) / 400 - np.minimum(expected, 1)).max() < 1.5 / 400


def test_draws_are_functions_of_their_generator(tmp_path: Path) -> None:
    files = [open_bursts(write_toy_shard(tmp_path, variant)) for variant in (13, 14)]
    a, b = (draw(files, MatcherTraining(samples=2, views=3), np.random.default_rng(5)) for _ in range(2))
    assert a.inputs.shape == (6, 4, 24, 32) and torch.equal(a.inputs, b.inputs)
    assert a.pairs.tolist() == [[0, 1], [0, 2], [1, 2], [3, 4], [3, 5], [4, 5]]
    assert a.inputs.isfinite().all()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("shards")
    return [open_bursts(write_toy_shard(folder, variant, width=64, height=48)) for variant in (13, 14, 15)]


def test_the_losses_fall(files) -> None:  # type: ignore[no-untyped-def]
    training = MatchTraining(files, TINY, SETTINGS, 0)
    losses = [training.train_step() for _ in range(40)]
    first, last = (np.mean([x.coarse for x in part]) for part in (losses[:10], losses[-10:]))
    assert last < first - 1.0
    assert np.mean([x.found for x in losses[-10:]]) > np.mean([x.found for x in losses[:10]])


def test_shards_of_several_image_sizes_are_refused(tmp_path: Path, files) -> None:  # type: ignore[no-untyped-def]
    other = open_bursts(write_toy_shard(tmp_path, 13))
    with pytest.raises(UserError, match="expected shards of one image size, found 32x24, 64x48"):
        MatchTraining([*files, other], TINY, SETTINGS, 0)


def test_a_killed_run_goes_on_with_the_same_bits_and_further(tmp_path: Path, files) -> None:  # type: ignore[no-untyped-def]
    key = training_key(TINY, SETTINGS, 0)
    whole, parts = (MatchTraining(files, TINY, SETTINGS, 0) for _ in range(2))
    run(whole, 6, key, tmp_path / "whole")
    run(parts, 3, key, tmp_path / "parts")
    again = MatchTraining(files, TINY, SETTINGS, 0)
    run(again, 6, key, tmp_path / "parts")
    assert again.step == 6
    saved = [load_checkpoint(tmp_path / name / "checkpoint.safetensors", key) for name in ("whole", "parts")]
    assert saved[0] is not None and saved[1] is not None
    same_tensors(saved[1].tensors, saved[0].tensors)  # of the network, of its mean and of Adam
    weights = tmp_path / "parts" / "matcher.safetensors"
    weights.unlink()
    run(MatchTraining(files, TINY, SETTINGS, 0), 6, key, tmp_path / "parts")
    assert weights.read_bytes() == (tmp_path / "whole" / "matcher.safetensors").read_bytes()


def test_weights_begin_a_training_at_their_step_with_a_warm_up(tmp_path: Path, files) -> None:  # type: ignore[no-untyped-def]
    run(MatchTraining(files[:1], TINY, SETTINGS, 0), 8, "key", tmp_path)
    weights = tmp_path / "matcher.safetensors"
    training = MatchTraining(files[1:], TINY, SETTINGS, 0, weights)
    kept = {name: tensor.float() for name, tensor in load_file(weights).items()}
    for name in ("live", "mean"):
        same_tensors(training.networks[name].state_dict(), kept)
    assert (training.step, training.warm_steps) == (8, 0)
    training.train_step()
    assert training.adam.groups[0].lr == pytest.approx(SETTINGS.lr / SETTINGS.warm_up)
    assert (training.step, training.warm_steps) == (9, 1)
    begun = MatchTraining(files[1:], TINY, SETTINGS, 0, weights)
    with pytest.raises(UserError, match="--steps: expected more than the 8 steps of the weights .*, found 8"):
        run(begun, 8, "third", tmp_path / "none")
    assert not (tmp_path / "none").exists()
    run(training, 10, "another", tmp_path / "on")
    assert (training.step, training.warm_steps) == (10, 2)
    card = WEIGHTS.read_card(tmp_path / "on" / "matcher.safetensors")
    assert card.steps == 10 and len(card.trained_on) == 3
    other = training_key(TINY, SETTINGS, 0, "sha")
    assert other != training_key(TINY, SETTINGS, 0)
