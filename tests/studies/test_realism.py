"""The classifier of real and simulated windows against closed forms, and the study on recordings that are simulated."""

import json
from functools import cache

import numpy as np
import pytest
from scipy.stats import norm
from small_scenes import shared_file

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.spikes.stream import open_stream, pack
from spike4dgs.generators.sensor.model import Sensor
from spike4dgs.studies.realism import windows as w
from spike4dgs.studies.realism.classifier import FOLDS, auc, auc_interval, out_of_fold, single_aucs
from spike4dgs.studies.realism.command import TILE, compare, fit_sensor, realism, sensor_with, split
from spike4dgs.studies.realism.ranks import MAKERS, agreement, makers_here, prediction_errors

PLAIN = Sensor(radiance_gain=1.0, photons=5e4)
SQUARE = 32  # px of a tile of the recording that is made here: a third fewer windows than with TILE


@pytest.mark.parametrize("shift", [0.0, 0.5, 1.5])
def test_the_auc_of_normal_variables_is_the_closed_form(shift):
    a, b = np.random.default_rng(0).normal(size=(2, 20_000))
    assert auc(a, b + shift) == pytest.approx(norm.cdf(shift / np.sqrt(2)), abs=0.01)
    assert auc(b + shift, a) == pytest.approx(1 - auc(a, b + shift))


def test_a_classifier_tells_no_more_than_there_is():
    rng = np.random.default_rng(1)
    a, b = rng.normal(size=(2, 1500, 6))
    folds = np.arange(1500) % FOLDS
    assert auc(*out_of_fold(a, b, folds)) == pytest.approx(0.5, abs=0.03)
    # The best score of two features shifted by 1 is their sum, whose shift is sqrt(2) of its standard deviation.
    b[:, :2] += 1
    scores = out_of_fold(a, b, folds)
    area, low, high = auc_interval(scores, np.arange(1500) // 10, rng)
    assert area == auc(*scores) == pytest.approx(norm.cdf(1), abs=0.02)
    assert low < norm.cdf(1) < high and high - low < 0.06
    assert [*single_aucs(tuple("abcdef"), a, b)][:2] in (["a", "b"], ["b", "a"])


def test_a_spread_is_told_without_a_shift():
    a, b = np.random.default_rng(2).normal(size=(2, 1500, 3))
    assert auc(*out_of_fold(a, 2 * b, np.arange(1500) % FOLDS)) > 0.8
    assert max(abs(v - 0.5) for v in single_aucs(("a", "b", "c"), a, 2 * b).values()) < 0.05


def periodic(*intervals, ticks=100):
    times = np.cumsum(np.tile(intervals, ticks))
    spikes = np.zeros((ticks, w.SIDE, w.SIDE), np.uint8)
    spikes[times[times < ticks]] = 1
    return spikes


def test_features_of_intervals_that_are_known():
    same, two, three = (w.features(periodic(*i)) for i in ((4,), (4, 5), (3, 5)))
    assert (same["one interval"], two["one interval"], three["one interval"]) == (1, 0, 0)
    assert (same["intervals two apart"], two["intervals two apart"], three["intervals two apart"]) == (0, 0, 1)
    assert same["even intervals"] == 1 and three["even intervals"] == 0
    assert two["next interval"] == pytest.approx(-1, abs=0.1)
    assert three["variance of 1 interval"] == pytest.approx(1, abs=0.01)  # 3 or 5, where 4 alone would do
    for found in (same, two, three):
        assert found["variance of 2 intervals"] == pytest.approx(0, abs=1e-9)
    assert same["pixel to the right"] == pytest.approx(1)  # all fire together
    assert same["all pixels"] == pytest.approx(w.SIDE**2)


@cache
def still(sensor=PLAIN, height=64, width=120, seed=3):
    light = np.random.default_rng(seed).uniform(0.15, 0.4, (height, width)).astype(np.float32)
    return light, w.record([light, light], [0, 2 * w.TICKS], sensor, seed)


def test_drawn_rates_are_near_the_truth_and_no_whole_intervals():
    light, spikes = still()
    drawn = w.drawn_rates(spikes[: w.TICKS], 0.0, np.random.default_rng(0))
    assert np.median(np.abs(drawn / light - 1)) < 0.004
    assert drawn.mean() == pytest.approx(light.mean(), rel=5e-4)
    assert (np.abs(1 / drawn - np.rint(1 / drawn)) < 1e-6).mean() < 1e-3
    few = np.zeros((w.TICKS, 8, 8), np.uint8)
    few[7, 0, 0] = 1
    assert np.isfinite(w.drawn_rates(few, 0.0, np.random.default_rng(0))).all()


@pytest.mark.parametrize("make", [w.counterpart, w.moving_counterpart])
def test_a_counterpart_has_equal_rates_and_is_not_told_apart(make):
    _, spikes = still()
    parts = make(spikes, PLAIN, 5)
    assert np.mean(parts) == pytest.approx(spikes.mean(), rel=2e-3)
    corners = w.corners_of(np.ones(spikes.shape[1:], bool))
    found = compare(w.halves(spikes), parts, corners).report(np.random.default_rng(0))
    assert found["windows"] == 2 * (64 // w.SIDE) * (120 // w.SIDE) and found["auc"] < 0.65


@pytest.mark.parametrize(
    ("options", "feature", "more"),
    [
        ({"read_noise": 0.02}, "intervals two apart", True),
        ({"reset_noise": 0.02}, "variance of 8 intervals", True),
        ({"clock_ripple": 0.01}, "one interval", True),
        ({"clock_ripple": 0.01, "photons": None}, "variance of 8 intervals", False),
    ],
)
def test_another_sensor_is_told_by_the_feature_that_shows_it(options, feature, more):
    light, spikes = still()
    other = w.halves(w.record([light, light], [0, 2 * w.TICKS], Sensor(**{**vars(PLAIN), **options}), 9))
    found = compare(w.halves(spikes), other, w.corners_of(np.ones(light.shape, bool)))
    report = found.report(np.random.default_rng(0))
    assert report["auc"] > 0.75
    alone = report["features"][feature]
    assert (alone if more else 1 - alone) > 0.7


def test_windows_lie_where_pixels_are_chosen():
    pixels = np.zeros((20, 33), bool)
    pixels[8:16, 16:32] = True
    pixels[8, 24:26] = False  # 62 of 64 are enough
    assert w.corners_of(pixels).tolist() == [[8, 16], [8, 24]]


def test_the_fit_finds_the_sensor_and_sees_half_the_squares(monkeypatch):
    monkeypatch.setattr("spike4dgs.studies.realism.command.GRID", ((0.0, 0.01), (0.012, 0.01), (0.0, 0.0)))
    light, spikes = still(sensor_with(0.012, 0.01), 80, 200)
    black, white = split(w.corners_of(np.ones(light.shape, bool)))
    assert not {*map(tuple, black)} & {*map(tuple, white)} and len(black) + len(white) == 10 * 25
    assert ((black // TILE).sum(1) % 2 == 0).all()
    assert fit_sensor(spikes, black, 1).reset_noise == 0.012


def test_long_windows_predict_still_pixels_better():
    _, spikes = still()
    errors = prediction_errors(spikes, {"all": np.ones(spikes.shape[1:], bool)})["all"]
    assert [*errors] == [*MAKERS]
    assert errors["tfp, 10 ticks"] > errors["tfp, 40 ticks"] > errors["tfp, 80 ticks"] > errors["adaptive"]
    assert agreement(errors, errors) == 1 and agreement(errors, {k: -v for k, v in errors.items()}) == -1


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A recording that is still but for bright light that moves at the lower left."""
    height, width, ticks = 4 * SQUARE, 6 * SQUARE, np.arange(0, 2 * w.TICKS + 1, 10)
    keys = np.random.default_rng(0).uniform(0.2, 0.3, (1, height, width)).repeat(len(ticks), 0)
    x = np.arange(3 * SQUARE)[None, None]
    keys[:, 2 * SQUARE :, : 3 * SQUARE] += 0.4 * (np.sin((x - 0.3 * ticks[:, None, None]) / 8) > 0)
    spikes = w.record(keys.astype(np.float32), ticks, sensor_with(0.0, 0.02), 1)
    path = tmp_path_factory.mktemp("real") / "real.dat"
    pack(spikes).tofile(path)
    return path


def test_the_study_finds_the_sensor_that_made_a_recording(recording, monkeypatch, tmp_path):
    monkeypatch.setattr("spike4dgs.studies.realism.command.TILE", SQUARE)
    monkeypatch.setattr("spike4dgs.studies.realism.ranks.NETWORKS", ("msdi",))  # the quickest of them
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- realism -->\nold\n<!-- end realism -->\nafter\n")
    size = {"width": 6 * SQUARE, "height": 4 * SQUARE}
    assert realism(recording, **size, reset_noise=0.0, clock_ripple=0.02, out=tmp_path / "out", page=page) == 0
    report = json.loads((tmp_path / "out/realism.json").read_text())
    assert report["still, before"]["auc"] > 0.7 > 0.62 > report["still, after"]["auc"]
    assert report["still, before"]["features"]["one interval"] < 0.3  # the recording has more of it
    assert set(report["ranks"]["kendall"]) == {"still", "beside motion", "moving"}
    for found in report["ranks"]["errors"].values():
        assert all({*errors} == {*MAKERS, "msdi"} for errors in found.values())
    text = page.read_text()
    assert text.startswith("before\n<!-- realism -->\n| windows") and "old" not in text and text.endswith("after\n")
    assert (tmp_path / "out/realism.png").stat().st_size > 1000
    assert (tmp_path / "out/realism.csv").read_text().startswith("case,feature,auc\n")


def test_a_recording_that_is_too_short_or_still_is_refused(monkeypatch, tmp_path):
    pack(still()[1][:150]).tofile(tmp_path / "short.dat")
    pack(still()[1]).tofile(tmp_path / "still.dat")
    monkeypatch.setattr("spike4dgs.studies.realism.command.GRID", ())
    with pytest.raises(UserError, match="expected 200 ticks or more, found 150"):
        realism(tmp_path / "short.dat", width=120, height=64, out=tmp_path)
    with pytest.raises(UserError, match="pixels in 5 places or more"):
        realism(tmp_path / "still.dat", width=120, height=64, out=tmp_path)


def test_a_real_camera_is_told_less_from_the_mended_sensor():
    path = shared_file("data/real_spikes/car_100kmh_250x400_200f.dat")
    spikes = open_stream(path, 400, 250, 4e4).window(0, 2 * w.TICKS)[:, :64, 200:]  # far from the car
    corners = w.corners_of(w.regions_of(spikes)["still"])
    areas = {}
    for name, sensor in {"before": sensor_with(0.0, 0.0), "after": sensor_with(0.008, 0.0065)}.items():
        found = compare(w.halves(spikes), w.counterpart(spikes, sensor, 1), corners)
        areas[name] = found.report(np.random.default_rng(0))["auc"]
    assert areas["before"] > 0.8 and areas["after"] < 0.7


def test_networks_predict_where_their_weights_are():
    _, spikes = still()
    makers = {name: makers_here()[name] for name in ("spk2img", "msdi", "tfp, 10 ticks", "tfp, 80 ticks")}
    errors = prediction_errors(spikes, {"all": np.ones(spikes.shape[1:], bool)}, makers)["all"]
    assert errors["tfp, 80 ticks"] < errors["spk2img"] < errors["tfp, 10 ticks"], "as a window of some ticks"
    assert errors["tfp, 80 ticks"] < errors["msdi"] < errors["tfp, 10 ticks"]
