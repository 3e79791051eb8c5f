"""Training bursts on disk: the format, and damaged files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from toy_bursts import toy_burst, write_toy_shard
from toy_world import ToyWorld

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.training_bursts import open_bursts, open_folder, stack_bursts, write_bursts


def test_bursts_survive_as_half_floats(tmp_path: Path) -> None:
    file = open_bursts(write_toy_shard(tmp_path, 13))
    assert len(file) == 2 and file.facts.id == "toy-13" and not file.facts.hidden
    for number, t in enumerate((0.3, 0.7)):
        expected, found = toy_burst(ToyWorld(width=32, height=24, seed=13), t), file.read(number)
        np.testing.assert_array_equal(found.moving, expected.moving)
        np.testing.assert_array_equal(found.w2c, expected.w2c)
        np.testing.assert_array_equal(found.K, expected.K)
        for name in ("keys", "depth", "gain", "dark"):
            np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-3, err_msg=name)
            assert getattr(found, name).dtype == np.float32


def test_rigs_at_rest_come_after_the_others(tmp_path: Path) -> None:
    moving = open_bursts(write_toy_shard(tmp_path, 13))
    bursts, background = [moving.read(0), moving.read(1)], (np.zeros((9, 24, 32)), np.ones((9, 24, 32)))
    nothing = np.zeros_like(bursts[0].moving)
    resting = replace(toy_burst(ToyWorld(width=32, height=24, seed=7), 0.4, count=3), moving=nothing)
    path = tmp_path / "toy-20.safetensors"
    write_bursts(path, replace(moving.facts, variant=20, resting=1), stack_bursts([bursts], [background], [resting]))
    file = open_bursts(path)
    assert len(file) == 3 and file.facts.resting == 1
    np.testing.assert_array_equal(file.read(1).keys[:, bursts[1].moving], bursts[1].keys[:, bursts[1].moving])
    found = file.read(2)
    assert not found.moving.any()
    for key in found.keys:
        np.testing.assert_allclose(key, resting.keys[0], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(found.depth, resting.depth, rtol=1e-3)
    np.testing.assert_array_equal(found.K, resting.K)


def test_equal_bursts_give_equal_files(tmp_path: Path) -> None:
    one, two = (write_toy_shard(tmp_path / name, 13) for name in "ab")
    assert one.read_bytes() == two.read_bytes()
    assert open_bursts(one).sha256 != open_bursts(write_toy_shard(tmp_path, 14)).sha256


def test_damaged_and_foreign_files_are_refused(tmp_path: Path) -> None:
    path = write_toy_shard(tmp_path, 13)
    whole, damaged = path.read_bytes(), "expected training bursts, found damaged data"
    other = whole.replace(b"spike4dgs-bursts/1", b"spike4dgs-bursts/9"), "bursts/1, found spike4dgs-bursts/9"
    for data, message in ((whole[:-100], damaged), other, (whole.replace(b"values.0.1", b"values.0.7"), damaged)):
        path.write_bytes(data)
        with pytest.raises(UserError, match=message):
            open_bursts(path).read(1)
    with pytest.raises(UserError, match="expected a folder of training bursts, found no"):
        open_folder(tmp_path / "empty")


def test_radiance_that_is_not_finite_is_not_written(tmp_path: Path) -> None:
    facts = open_bursts(write_toy_shard(tmp_path, 13)).facts
    with pytest.raises(UserError, match="expected finite radiances, found 1 that are not in values"):
        write_bursts(tmp_path / "x.safetensors", facts, {"values.0.0": np.array([1, np.nan], np.float16)})
    assert not (tmp_path / "x.safetensors").exists()
