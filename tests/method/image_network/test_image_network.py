"""The image network's inputs, its start at `adaptive`'s image, its losses in decibels, and its training's bits."""

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
from spike4dgs.benchmark.scene.calibration import Calibration, Recordings, estimate
from spike4dgs.benchmark.scene.training_bursts import open_bursts
from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.checkpoint import load_checkpoint
from spike4dgs.method.image_network.config import INPUTS, MOVING_LOSS, TINY, ImageTraining
from spike4dgs.method.image_network.inputs import BESIDE, image_inputs
from spike4dgs.method.image_network.maker import reconstruct
from spike4dgs.method.image_network.network import ImageNetwork, log_mse, rate_of
from spike4dgs.method.image_network.training import data
from spike4dgs.method.image_network.training.data import draw, seen
from spike4dgs.method.image_network.training.evaluate import CONDITIONS, evaluate
from spike4dgs.method.image_network.training.sprites import Clip, still, with_sprites
from spike4dgs.method.image_network.training.train import ImageNetworkTraining, run, training_key
from spike4dgs.method.image_network.weights import WEIGHTS, load_image_network
from spike4dgs.method.images.adaptive import adaptive_image
from spike4dgs.method.matching.training.data import at_light, record
from spike4dgs.method.matching.window_inputs import rates_over_windows, window_inputs
from spike4dgs.method.msdi.training_data import Pixels, fire

SETTINGS = ImageTraining(steps=6, bursts=2, views=1, instants=2, warm_up=2, longest=120)


def _stream(seed: int = 0, ticks: int = 120) -> SpikeStream:
    rng = np.random.default_rng(seed)
    rate = rng.uniform(0.05, 0.6, (10, 14))
    return SpikeStream(pack(rng.random((ticks, 10, 14)) < rate), 14, 10, 20_000.0)


def test_inputs_are_adaptive_images_in_roots_of_the_clips_mean() -> None:
    stream, rng = _stream(), np.random.default_rng(1)
    gain, dark = (rng.uniform(*ends, (10, 14)).astype(np.float32) for ends in ((0.8, 1.2), (0, 0.02)))
    found = image_inputs(stream, 50, (gain, dark))
    whole = np.maximum((stream.counts(0, 120) / 120 - dark) / gain, 0)
    assert found.unit == pytest.approx(whole.mean(), rel=1e-5)
    for channel, tick in ((0, 50), (4, 50 - BESIDE), (5, 50 + BESIDE)):
        rate = np.maximum((adaptive_image(stream, tick) - dark) / gain, 0)
        np.testing.assert_allclose(found.channels[channel], np.sqrt(rate / whole.mean()) - 1, atol=1e-5)
    np.testing.assert_allclose(found.channels[3], np.sqrt(whole / whole.mean()) - 1, atol=1e-5)
    np.testing.assert_array_equal(found.channels[1:3], window_inputs(stream, 50, (gain, dark))[1:3])
    np.testing.assert_allclose(found.channels[6], gain - 1, atol=1e-6)
    assert (found.channels[7] == 1).all()
    np.testing.assert_array_equal(found.spikes, stream.window(30, 71))


def test_the_whole_stream_is_more_than_its_first_65535_ticks() -> None:
    """Light of 0.1 spikes a tick, then of 0.5 in as many ticks."""
    spikes = np.zeros((131_070, 2, 4), bool)
    spikes[5:65_535:10] = spikes[65_535::2] = True
    assert rates_over_windows(SpikeStream(pack(spikes), 4, 2, 20_000.0), 100).mean == pytest.approx(0.3, abs=1e-4)


def test_a_sensor_that_is_not_known_leaves_its_channels_at_nothing() -> None:
    found = image_inputs(_stream(), 50)
    assert not found.channels[6:].any()


def test_a_shading_alone_corrects_the_images_of_a_sensor_that_is_not_known() -> None:
    stream, shading = _stream(), np.linspace(0.8, 1.2, 140, dtype=np.float32).reshape(10, 14)
    sensor = shading, np.zeros_like(shading)
    found, known = image_inputs(stream, 50, sensor, of_pixels=False), image_inputs(stream, 50, sensor)
    np.testing.assert_array_equal(found.channels[:6], known.channels[:6])
    assert not found.channels[6:].any() and known.channels[7].all()
    network = ImageNetwork(TINY).eval()
    torch.nn.init.normal_(network.change.weight)
    told = reconstruct(network, stream, 50, Calibration.of_shading(shading, 0.6))
    assert not np.array_equal(told, reconstruct(network, stream, 50, Calibration(*sensor, 0.6)))
    assert not np.array_equal(told, reconstruct(network, stream, 50))


def test_ends_of_the_clip_have_inputs_of_the_ticks_that_are_there() -> None:
    stream = _stream()
    first, last = image_inputs(stream, 0), image_inputs(stream, 119)
    np.testing.assert_array_equal(first.channels[4], first.channels[0])
    np.testing.assert_array_equal(last.channels[5], last.channels[0])
    assert first.spikes.shape == last.spikes.shape == (41, 10, 14)


def test_a_bright_pixel_among_dark_ones_keeps_its_value() -> None:
    spikes = np.zeros((400, 8, 8))
    spikes[:, 2, 2], spikes[::20, :, 5] = 1, 1
    found = image_inputs(SpikeStream(pack(spikes), 8, 8, 20_000.0), 200)
    rate = rate_of(torch.from_numpy(found.channels[0]), found.unit)
    assert rate[2, 2].item() == pytest.approx(1, abs=1e-3) and rate[1, 5].item() == pytest.approx(0.05, abs=1e-3)


@pytest.mark.parametrize("size", [(10, 14), (5, 3), (8, 8)])
def test_an_untrained_network_gives_adaptives_image(size: tuple[int, int]) -> None:
    stream = SpikeStream(pack(np.random.default_rng(0).random((60, *size)) < 0.3), size[1], size[0], 20_000.0)
    image = reconstruct(ImageNetwork(TINY).eval(), stream, 30)
    assert image.dtype == np.float32 and image.shape == size
    np.testing.assert_allclose(image, adaptive_image(stream, 30), rtol=1e-5, atol=1e-6)


def test_spikes_are_corrected_for_a_known_sensitivity_and_a_dead_pixel_is_silent() -> None:
    network = ImageNetwork(TINY).eval()
    torch.nn.init.normal_(network.change.weight)
    channels, spikes = torch.zeros(1, 8, 8, 8), torch.ones(1, 41, 8, 8)
    channels[:, 6] = 1.0  # twice as sensitive
    halved = torch.zeros(1, 8, 8, 8)
    with torch.no_grad():
        network.stem[0].weight[:, 6:8] = 0  # type: ignore[index, operator]
        torch.testing.assert_close(network(channels, spikes), network(halved, spikes / 2))
        channels[:, 6] = -1.0
        torch.testing.assert_close(network(channels, spikes), network(halved, spikes * 0))


@pytest.mark.parametrize("part", [*INPUTS])
def test_a_network_without_an_input_does_not_depend_on_it(part: str) -> None:
    network = ImageNetwork(replace(TINY, without=part)).eval()
    torch.nn.init.normal_(network.change.weight)
    draws = torch.Generator().manual_seed(0)
    channels, spikes = (torch.rand(1, n, 8, 8, generator=draws) for n in (8, 41))
    channels[:, 6] = 0  # of a usual pixel: spikes are divided by it
    changed = channels.clone(), spikes.clone()
    if part == "spikes":
        changed[1].fill_(1.0)
    else:
        changed[0][:, slice(7, 8) if part == "sensor" else INPUTS[part]] += 1
    with torch.no_grad():
        torch.testing.assert_close(network(*changed), network(channels, spikes), rtol=0, atol=0)
        network.config = TINY
        assert not torch.equal(network(*changed), network(channels, spikes))


def test_losses_are_psnr_but_for_sign_and_factor() -> None:
    rng = np.random.default_rng(0)
    truth, found = (torch.from_numpy(rng.random((3, 6, 7))) for _ in range(2))
    weight = torch.ones_like(truth)
    weight[1] = 0  # an image in which nothing moves
    weight[2, :3] = 0
    errors = [(found[0] - truth[0]).square().mean(), (found[2, 3:] - truth[2, 3:]).square().mean()]
    expected = np.mean([np.log(e.item()) for e in errors])
    assert log_mse(found, truth, weight).item() == pytest.approx(expected, abs=1e-4)
    assert log_mse(found, truth, weight * 0).item() == 0


def _fade(ticks: int = 81) -> Clip:
    """A clip in which all light rises linearly, by 0.01 a tick from 0.1 on."""
    keys = np.stack([np.full((24, 32), 0.1 + 0.01 * t, np.float32) for t in (0, 30, 60, 90)])
    return Clip(keys, np.zeros(keys.shape, bool), 30)


@pytest.mark.parametrize("tick", [0, 40, 60, 80])
def test_the_truth_is_the_light_at_the_instant(tick: int) -> None:
    rng = np.random.default_rng(0)
    maps = (rng.uniform(0.9, 1.1, (24, 32)).astype(np.float32), np.full((24, 32), 0.005, np.float32))
    batch = seen(_fade(), maps, at_light(0.5, True, 81), [tick], (0.6, 5e4), rng)
    rate = rate_of(batch.truth[0], batch.units[0])
    assert rate.numpy() == pytest.approx((0.1 + 0.01 * tick) * 0.6 * 0.5, rel=1e-4)
    assert not batch.moving.any()


def test_spikes_of_a_clip_are_those_of_its_light() -> None:
    maps = (np.ones((24, 32), np.float32), np.zeros((24, 32), np.float32))
    batch = seen(_fade(), maps, at_light(1.0, False, 81), [20, 60], (0.6, np.inf), np.random.default_rng(0))
    for spikes, tick in zip(batch.spikes.double(), (20, 60), strict=True):  # 20 ticks to each side
        assert spikes.mean().item() == pytest.approx((0.1 + 0.01 * (tick + 0.5)) * 0.6, rel=0.02)


def test_a_known_sensor_is_known_as_well_as_recordings_tell() -> None:
    """Those of scenes: 500 ticks under uniform light of 0.42 spikes a tick, and 2000 in the dark."""
    rng, size = np.random.default_rng(0), (32, 48)
    gain = np.exp(0.05 * rng.standard_normal(size)).astype(np.float32)
    dark = rng.uniform(0.003, 0.006, size).astype(np.float32)
    gain /= gain.mean()
    streams = []
    for light, ticks in ((0.42, 500), (0.0, 2000)):
        pixels = Pixels(np.full((2, *size), light, np.float32), gain, dark, 5e4, ticks)
        streams.append(SpikeStream(pack(fire(pixels, ticks, rng.random(size, np.float32), rng)), 48, 32, 20_000.0))
    found = estimate(Recordings(streams[0], streams[1], 0.7))
    batch = seen(still(np.full(size, 0.5, np.float32), 41), (gain, dark), at_light(1.0), [20], (0.6, 5e4), rng)
    trained = (batch.channels[0, 6].numpy() + 1) / gain - 1
    assert trained.std() == pytest.approx((found.gain / gain - 1).std(), rel=0.3)
    assert data._DARK_ERROR == pytest.approx((found.dark - dark).std(), rel=0.5)


def test_a_sprite_covers_what_is_behind_it_and_moves_as_its_path_says() -> None:
    """A bright sprite before black: its light's middle moves evenly, or accelerates; elsewhere nothing changes."""
    for seed in range(6):
        rng = np.random.default_rng(seed)
        clip = with_sprites(np.zeros((64, 96), np.float32), [np.ones((64, 104), np.float32)], 300, rng)
        assert len(clip.keys) == -(-300 // clip.spacing) + 1
        assert (clip.keys >= 0).all() and clip.keys[~clip.covered].max() < 0.06
        v, u = np.mgrid[:64, :96]
        inside = [k for k, seen in enumerate(clip.covered) if seen[3:-3, 3:-3].sum() == seen.sum() > 30]
        middles = [complex((clip.keys[k] * u).sum(), (clip.keys[k] * v).sum()) / clip.keys[k].sum() for k in inside]
        if len(middles) > 3 and np.diff(inside).max() == 1 and clip.keys[inside[0]].max() > 0.5:
            assert np.abs(np.diff(middles)).max() < 1.2, "images lie densely"
            assert np.abs(np.diff(middles, n=3)).max() < 0.1, "a path is a parabola"


def _before_black(other: np.ndarray, seed: int) -> Clip:
    return with_sprites(np.zeros((64, 96), np.float32), [other], 300, np.random.default_rng(seed))


def test_the_light_of_sprites_is_exact() -> None:
    """A sprite of one brightness has it throughout, before a background that it covers fully and leaves as it is."""
    rng = np.random.default_rng(0)
    background, even = rng.random((64, 96), np.float32), np.ones((64, 104), np.float32)
    for seed in (1, 3, 4):
        alone = _before_black(even, seed).keys
        within = alone > 0.999 * alone.max()
        clip = with_sprites(background, [even], 300, np.random.default_rng(seed))
        assert (clip.keys >= 0).all() and within.sum() > 1000
        np.testing.assert_allclose(clip.keys[within], alone.max(), rtol=2e-3)
        k, v, u = np.nonzero(~clip.covered & (alone == 0))
        np.testing.assert_array_equal(clip.keys[k, v, u], background[v, u])


def test_what_moves_is_about_as_sharp_as_an_image() -> None:
    """Neighbouring pixels of a white texture stay nearly independent, and lose a fifth of what averages leave."""
    white = (1 + 0.2 * np.random.default_rng(9).standard_normal((48, 104))).astype(np.float32)  # less than a sprite's
    kept, alike = [], []
    for seed in (1, 3, 4, 10):
        even, clip = _before_black(np.ones_like(white), seed).keys, _before_black(white, seed).keys
        within = even > 0.999 * even.max()
        k = int(within.sum(axis=(1, 2)).argmax())
        texture, both = clip[k] / even.max(), within[k, :, 1:] & within[k, :, :-1]
        variance = texture[within[k]].var()
        kept.append(np.sqrt(variance))
        alike.append(1 - np.diff(texture)[both].var() / (2 * variance))
    assert np.mean(kept) > 0.75 * 0.2 / 2 and np.mean(alike) < 0.2


def test_a_clip_at_rest_has_one_image() -> None:
    clip = still(np.full((4, 5), 0.3, np.float32), 77)
    for tick in (0, 40, 76):
        light, moving = clip.at(tick)
        assert light == pytest.approx(0.3) and not moving.any()


def test_what_moves_counts_as_moving_a_little_before_and_after() -> None:
    covered = np.zeros((41, 2, 2), bool)
    covered[20] = True
    clip = Clip(np.zeros((41, 2, 2), np.float32), covered, 5)
    ticks = [t for t in range(200) if clip.at(t)[1].all()]
    assert min(ticks) in range(84, 92) and max(ticks) in range(108, 116)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory):  # type: ignore[no-untyped-def]
    folder = tmp_path_factory.mktemp("shards")
    return [open_bursts(write_toy_shard(folder, variant, resting=1)) for variant in (13, 14)]


def test_batches_are_functions_of_their_generator(files) -> None:  # type: ignore[no-untyped-def]
    a, b = (draw(files, SETTINGS, np.random.default_rng(5)) for _ in range(2))
    assert a.channels.shape == (4, 8, 24, 32) and a.spikes.shape == (4, 41, 24, 32)
    assert all(torch.equal(getattr(a, name), getattr(b, name)) for name in ("channels", "spikes", "truth", "moving"))


def test_a_killed_training_goes_on_with_the_same_bits(tmp_path: Path, files) -> None:  # type: ignore[no-untyped-def]
    key = training_key(TINY, SETTINGS, 0)
    run(ImageNetworkTraining(files, TINY, SETTINGS, "cpu", 0), key, tmp_path / "whole")
    killed = ImageNetworkTraining(files, TINY, SETTINGS, "cpu", 0)
    (tmp_path / "parts").mkdir()
    for batch in killed.batches():
        killed.train_step(batch)
        if killed.step == 3:
            break
    killed.save(tmp_path / "parts" / "checkpoint.safetensors", key)
    run(ImageNetworkTraining(files, TINY, SETTINGS, "cpu", 0), key, tmp_path / "parts")
    saved = [load_checkpoint(tmp_path / name / "checkpoint.safetensors", key) for name in ("whole", "parts")]
    assert saved[0] is not None and saved[1] is not None and saved[0].step == saved[1].step == 6
    same_tensors(saved[1].tensors, saved[0].tensors)
    card = WEIGHTS.read_card(tmp_path / "whole" / "images.safetensors")
    assert card.steps == 6 and len(card.trained_on) == 2
    (tmp_path / "parts" / "images.safetensors").unlink()
    run(ImageNetworkTraining(files, TINY, SETTINGS, "cpu", 0), key, tmp_path / "parts")
    assert WEIGHTS.read_card(tmp_path / "parts" / "images.safetensors") == card


def test_the_weights_in_use_are_a_mean_that_follows_those_that_learn(files) -> None:  # type: ignore[no-untyped-def]
    training = ImageNetworkTraining(files, TINY, SETTINGS, "cpu", 0)
    steps, batch = [], draw(files, SETTINGS, np.random.default_rng(0))
    expected = training.live.change.bias.detach().clone()
    for step in range(1, 4):
        training.train_step(batch)
        steps.append(training.live.change.bias.detach().clone())
        expected += (1 - step / (step + 9)) * (steps[-1] - expected)
    torch.testing.assert_close(training.network.change.bias.detach(), expected)
    assert not torch.equal(steps[-1], expected) and min(steps) < expected < max(steps)


def test_shards_must_have_room_for_crops_of_one_size(tmp_path: Path, files) -> None:  # type: ignore[no-untyped-def]
    larger = open_bursts(write_toy_shard(tmp_path, 13, width=48, height=32))
    with pytest.raises(UserError, match="expected shards with room for crops of one size, found 32x24, 48x32"):
        ImageNetworkTraining([*files, larger], TINY, SETTINGS, "cpu", 0)
    both = [*files, larger]
    small = replace(SETTINGS, crop=(24, 32))
    assert draw(both, small, np.random.default_rng(1)).channels.shape[2:] == (24, 32)
    ImageNetworkTraining(both, TINY, small, "cpu", 0)


def test_a_training_begins_with_given_weights_and_their_shards(tmp_path: Path, files) -> None:  # type: ignore[no-untyped-def]
    run(ImageNetworkTraining(files[:1], TINY, SETTINGS, "cpu", 0), training_key(TINY, SETTINGS, 0), tmp_path)
    weights = tmp_path / "images.safetensors"
    training = ImageNetworkTraining(files[1:], TINY, SETTINGS, "cpu", 0, weights)
    same_tensors(training.network.state_dict(), {name: t.float() for name, t in load_file(weights).items()})
    assert training.step == 0 and all(p.requires_grad for p in training.network.parameters())
    first = {  # of the same shards, without the weights and with them
        name: next(iter(ImageNetworkTraining(files[1:], TINY, SETTINGS, "cpu", 0, start).batches()))
        for name, start in (("anew", None), ("on", weights))
    }
    assert not torch.equal(first["anew"].truth, first["on"].truth), "it does not see the same batches again"
    run(training, training_key(TINY, SETTINGS, 0, "sha"), tmp_path / "on")
    card = WEIGHTS.read_card(tmp_path / "on" / "images.safetensors")
    assert len(card.trained_on) == 2 and card.steps == 12
    assert training_key(TINY, SETTINGS, 0, "sha") != training_key(TINY, SETTINGS, 0)


def test_without_the_moving_loss_what_moves_counts_as_the_rest(files) -> None:  # type: ignore[no-untyped-def]
    batch = draw(files, SETTINGS, np.random.default_rng(0))
    steps = {}
    for moving in (batch.moving, ~batch.moving):
        for without in ("", MOVING_LOSS):
            training = ImageNetworkTraining(files, replace(TINY, without=without), SETTINGS, "cpu", 0)
            training.train_step(replace(batch, moving=moving))
            steps[bool(moving is batch.moving), without] = training.network.change.weight.detach().clone()
    assert torch.equal(steps[True, MOVING_LOSS], steps[False, MOVING_LOSS])
    assert not torch.equal(steps[True, ""], steps[False, ""])


def test_scores_of_an_untrained_network_are_adaptives(tmp_path: Path) -> None:
    file = open_bursts(write_toy_shard(tmp_path, 10, width=48, height=32))
    scores = evaluate(ImageNetwork(TINY).eval(), [file])
    assert [s.condition for s in scores] == list(CONDITIONS)
    for score in scores:
        assert score.network == pytest.approx(score.adaptive, abs=1e-3)
    known, quarter, sixteenth, unknown = (score.adaptive[0] for score in scores)
    assert known is not None and quarter is not None and sixteenth is not None and unknown is not None
    assert known > quarter > sixteenth and known > unknown


@pytest.mark.parametrize(("known", "light", "share"), [(True, 1.0, 1.05), (True, 1 / 16, 0.7), (False, 1.0, 0.9)])
def test_the_shipped_networks_squared_error_is_a_share_of_adaptives(known: bool, light: float, share: float) -> None:
    """In the dark, and where the sensor is not known, neighbours tell much; in full light, little."""
    burst = toy_burst(ToyWorld(width=64, height=48, seed=7), 0.5)
    under = at_light(light, known, 120)
    network = load_image_network(WEIGHTS.in_use().path, "cpu")
    streams = record(burst, 0.6, 1000.0, under, np.random.default_rng(0))
    truth = np.sqrt(burst.keys[1] * 0.6 * light)
    errors: dict[str, list[float]] = {"adaptive": [], "network": []}
    for v, stream in enumerate(streams):
        seen_by = image_inputs(stream, under.instant, (burst.gain[v], burst.dark[v]) if known else None)
        with torch.inference_mode():
            root = network(*(torch.from_numpy(a)[None] for a in (seen_by.channels, seen_by.spikes)))[0]
        for name, found in (("adaptive", torch.from_numpy(seen_by.channels[0])), ("network", root)):
            image = np.sqrt(rate_of(found, seen_by.unit).numpy())
            errors[name].append(float(np.square(image - truth[v]).mean()))
    assert np.mean(errors["network"]) < share * np.mean(errors["adaptive"])
