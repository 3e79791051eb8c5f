import tempfile
from pathlib import Path

import pytest
import safetensors.torch
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from spike4dgs.benchmark.errors import UserError
from spike4dgs.method.checkpoint import Checkpoint, load_checkpoint, save_checkpoint


def some(step: int = 7) -> Checkpoint:
    rng = torch.Generator().manual_seed(0)
    tensors = {
        "gaussians.means": torch.randn(5, 3, generator=rng),
        "adam.means.0.step": torch.tensor(3.0),
        "motion.low": torch.tensor([float("nan"), -0.0, float("inf")]),
        "motion.empty": torch.zeros(0, 4),
        "statistics.seen": torch.arange(4),
    }
    return Checkpoint(step, tensors)


def same_bits(a: Checkpoint, b: Checkpoint) -> bool:
    return (a.step, a.tensors.keys()) == (b.step, b.tensors.keys()) and all(
        v.dtype == b.tensors[k].dtype and v.numpy().tobytes() == b.tensors[k].numpy().tobytes()
        for k, v in a.tensors.items()
    )


def test_what_is_saved_comes_back_to_its_fit(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "fit.safetensors"
    path.parent.mkdir()
    assert load_checkpoint(path, "fit") is None
    for step in (7, 8):  # the second replaces the first
        save_checkpoint(path, some(step), "fit")
    loaded = load_checkpoint(path, "fit")
    assert loaded is not None and same_bits(loaded, some(8))
    assert [p.name for p in path.parent.iterdir()] == ["fit.safetensors"]  # nothing temporary is left
    assert loaded.part("adam").keys() == {"means.0.step"} and not loaded.part("mean")
    with pytest.raises(UserError, match="expected a checkpoint of this scene, .*found another fit's"):
        load_checkpoint(path, "other")


def test_tensors_that_require_gradients_or_are_not_contiguous_are_saved(tmp_path: Path) -> None:
    value = torch.arange(6.0).reshape(2, 3).T.requires_grad_(True)
    save_checkpoint(tmp_path / "c", Checkpoint(1, {"x": value}), "fit")
    loaded = load_checkpoint(tmp_path / "c", "fit")
    assert loaded is not None and torch.equal(loaded.tensors["x"], value)


@pytest.fixture(scope="module")
def whole() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        save_checkpoint(Path(folder) / "c", some(), "fit")
        return (Path(folder) / "c").read_bytes()


@settings(max_examples=150, deadline=None)
@given(at=st.floats(0, 1, exclude_max=True), bit=st.integers(0, 7))
def test_a_flipped_bit_anywhere_is_found(whole: bytes, at: float, bit: int) -> None:
    damaged = bytearray(whole)
    damaged[int(at * len(whole))] ^= 1 << bit
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "fit.safetensors"
        path.write_bytes(damaged)
        try:
            loaded = load_checkpoint(path, "fit")
        except UserError as e:
            assert "fit.safetensors: expected" in str(e) and "delete it to fit from the start" in str(e)
            assert "\n" not in str(e)
        else:
            assert loaded is not None and same_bits(loaded, some())  # the bit meant nothing


@pytest.mark.parametrize("length", [0, 1, 7, 8, 100, -1])
def test_a_file_that_was_cut_off_is_refused(whole: bytes, length: int, tmp_path: Path) -> None:
    path = tmp_path / "fit.safetensors"
    path.write_bytes(whole[:length])
    with pytest.raises(UserError, match=r"fit\.safetensors: expected a checkpoint, found damaged data"):
        load_checkpoint(path, "fit")


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        (None, "expected schema spike4dgs-checkpoint/1, found None"),
        ({"schema": "somebody/2"}, "found 'somebody/2'"),
        ({"schema": "spike4dgs-checkpoint/1", "fit": "fit"}, "damaged data"),
        ({"schema": "spike4dgs-checkpoint/1", "fit": "fit", "step": "soon"}, "damaged data"),
    ],
)
def test_a_foreign_file_of_the_same_format_is_refused(metadata: dict[str, str] | None, message: str, tmp_path) -> None:
    path = tmp_path / "fit.safetensors"
    safetensors.torch.save_file({"x": torch.zeros(2)}, path, metadata=metadata)
    with pytest.raises(UserError, match=message):
        load_checkpoint(path, "fit")
