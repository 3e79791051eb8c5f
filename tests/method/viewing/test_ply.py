"""The files of `export-ply`, read by a reader of its own: rendered again they give the model's images."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from saved_models import DURATION_US, WORLD, model, provenance

from spike4dgs.benchmark.errors import UserError
from spike4dgs.cli import main
from spike4dgs.method.gaussians.parameters import Gaussians
from spike4dgs.method.splat import PixelFilter, Splats, Views, render
from spike4dgs.method.viewing.ply import for_viewers, to_ply, write_ply

FIELDS = "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3".split()


def read_ply(path: Path) -> dict[str, np.ndarray]:
    """The vertices by property, as a reader of the format sees them."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(lines[2].removeprefix("element vertex "))
    names = [line.removeprefix("property float ") for line in lines[3:]]
    assert len(body) == count * 4 * len(names)
    rows = np.frombuffer(body, np.dtype([(name, "<f4") for name in names]))
    return {name: rows[name].astype(np.float64) for name in names}


def activated(v: dict[str, np.ndarray]) -> Splats:
    """What a viewer makes of a file; its display values are decoded to linear radiance."""

    def columns(*names: str) -> torch.Tensor:
        return torch.as_tensor(np.stack([v[name] for name in names], axis=1)).float()

    shown = 0.5 + v["f_dc_0"] / (2 * np.sqrt(np.pi))
    linear = np.where(shown <= 0.04045, shown / 12.92, ((np.maximum(shown, 0.04045) + 0.055) / 1.055) ** 2.4)
    return Splats(
        columns("x", "y", "z"),
        columns("rot_0", "rot_1", "rot_2", "rot_3"),
        columns("scale_0", "scale_1", "scale_2").exp(),
        torch.as_tensor(1 / (1 + np.exp(-v["opacity"]))).float(),
        torch.as_tensor(linear)[:, None].float(),
    )


@pytest.fixture
def saved(tmp_path: Path, request: pytest.FixtureRequest) -> Path:
    path = tmp_path / "model.safetensors"
    model(request.param).save(path, provenance())
    return path


@pytest.mark.parametrize(
    "saved", ["static", "hexplane", "hexplane, background", "paths", "spacetime-lite", "tracking"], indirect=True
)
def test_the_files_render_as_the_model_does(saved: Path, tmp_path: Path, request: pytest.FixtureRequest) -> None:
    assert main(["export-ply", str(saved), "--out", str(tmp_path / "out"), "--times", "4"]) == 0
    files = sorted((tmp_path / "out").iterdir())
    assert [f.name for f in files] == [f"{tick:06d}.ply" for tick in (12, 37, 62, 87)]
    made, camera = model(request.node.callspec.params["saved"]), WORLD.cameras[1]
    for file in files:
        vertices = read_ply(file)
        assert list(vertices) == FIELDS
        assert not any(vertices[n].any() for n in ("nx", "ny", "nz"))
        assert (vertices["f_dc_0"] == vertices["f_dc_1"]).all() and (vertices["f_dc_0"] == vertices["f_dc_2"]).all()
        expected = made.render(camera, int(file.stem) / WORLD.n_ticks * DURATION_US)
        found = render(activated(vertices), Views.from_cameras([camera])).image[0, ..., 0].clamp(min=0).numpy()
        assert expected.max() > 0.1
        np.testing.assert_allclose(found, expected, atol=2e-4)


def test_a_compensated_filters_light_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The viewers' filter makes Gaussians of about a pixel brighter, here by 13.6 % in all."""

    def small(g: Gaussians) -> Gaussians:
        return replace(g, log_scales=g.log_scales + np.log(0.25))

    made = model("hexplane, background")
    pieces, background = tuple(small(piece) for piece in made.pieces), small(made.background)
    made = replace(made, pieces=pieces, background=background, pixel_filter=PixelFilter(1 / 12, True))
    made.save(tmp_path / "model", provenance())
    assert main(["export-ply", str(tmp_path / "model"), "--out", str(tmp_path / "out"), "--times", "1"]) == 0
    assert "fitted with a compensated filter of 0.0833 px^2" in capsys.readouterr().out
    expected = made.render(WORLD.held_out, 0.5 * DURATION_US)

    def errors(splats: Splats) -> tuple[float, float]:
        with torch.no_grad():
            found = render(splats, Views.from_cameras([WORLD.held_out])).image[0, ..., 0].clamp(min=0).numpy()
        return abs(found.mean() / expected.mean() - 1), float(np.square(found - expected).mean())

    light, error = errors(activated(read_ply(tmp_path / "out/000050.ply")))
    light_before, error_before = errors(made.splats(0.5 * DURATION_US))
    assert light < 0.01 < 0.1 < light_before
    assert error < error_before / 3, "5 dB"
    seen, one = torch.tensor([[0.0, 0.3, 0.7]]), torch.ones(1)
    tiny = for_viewers(
        Splats(seen, torch.ones(1, 4), torch.full((1, 3), 1e-5), one, one[None]), WORLD.cameras, made.pixel_filter
    )
    assert tiny.opacities[0] < 1e-3, "what is far smaller than a pixel gives no light"


def test_extreme_gaussians_stay_finite_and_faded_ones_are_left_out(tmp_path: Path) -> None:
    splats = Splats(
        torch.eye(4)[:, :3],
        torch.tensor([[2.0, 0, 0, 0], [0, 0, 0, 0.1], [1, 1, 1, 1], [1, 0, 0, 0]]),
        torch.full((4, 3), 0.1) * torch.tensor([[1.0], [1.0], [0.0], [1.0]]),
        torch.tensor([1.0, 0.5, 0.5, 0.001]),
        torch.tensor([[3.0], [-0.2], [0.5], [0.5]]),
    )
    (tmp_path / "a.ply").write_bytes(to_ply(splats))
    vertices = read_ply(tmp_path / "a.ply")
    assert len(vertices["x"]) == 3 and all(np.isfinite(v).all() for v in vertices.values())
    back = activated(vertices)
    np.testing.assert_allclose(back.colors[:, 0], [3.0, -0.2, 0.5], atol=1e-5)
    np.testing.assert_allclose(back.opacities, [1.0, 0.5, 0.5], atol=1e-5)
    np.testing.assert_allclose(back.quats.norm(dim=1), 1, atol=1e-6)


@pytest.mark.parametrize(
    ("saved", "message"),
    [
        ("radiance-field", "expected a model of Gaussians, found toy+4dgs, a radiance field"),
        ("spacetime", "expected Gaussians with a gray value, found toy+4dgs, whose colours a network decodes"),
    ],
    indirect=["saved"],
)
def test_models_that_no_ply_can_hold_are_refused(saved: Path, message: str, tmp_path: Path, capsys) -> None:
    assert main(["export-ply", str(saved), "--out", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not (tmp_path / "out").exists()


@pytest.mark.parametrize("saved", ["static"], indirect=True)
def test_bad_numbers_of_times(saved: Path, tmp_path: Path) -> None:
    for times in (0, 101):
        with pytest.raises(UserError, match=f"--times: expected 1 to 100, the ticks of the clip, found {times}"):
            write_ply(saved, tmp_path / "out", times)
    with pytest.raises(UserError, match="a new or empty folder"):
        write_ply(saved, tmp_path, 1)
