"""Cycles on worlds whose light is known in closed form; skipped where `bpy` is not installed."""

import os
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from spike4dgs.benchmark.errors import UserError
from spike4dgs.benchmark.scene.cameras import look_at
from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators.worlds import WORLDS
from spike4dgs.generators.worlds.base import Part, WorldScene
from spike4dgs.generators.worlds.meshes import box, quad
from spike4dgs.generators.worlds.surfaces import Lamp, Material
from spike4dgs.studies.second_renderer.checks import CHECKS
from spike4dgs.studies.second_renderer.coat import IOR, coat, crossing
from spike4dgs.studies.second_renderer.command import second_renderer
from spike4dgs.studies.second_renderer.renderings import Blender, find_blender, render_ours, render_second

WIDTH, HEIGHT = 40, 24
WORLD, GREY = next(c for c in CHECKS if c.id == "world"), next(c for c in CHECKS if c.id == "grey")
FLOOR = quad((0, 0, 0), (40, 0, 0), (0, 40, 0))
CAMERA = look_at(
    "cam_00", np.array([0.3, -2, 2.5]), np.zeros(3), np.array([0, 0, 1.0]), focal=50.0, width=WIDTH, height=HEIGHT
)


@pytest.fixture(scope="module")
def blender() -> Blender:
    try:
        return find_blender(None)
    except UserError as e:
        pytest.skip(str(e))


def world(emitters: dict, **static: Part) -> WorldScene:
    """Return a world of static surfaces, with a board out of sight that moves: our scene needs a moving surface."""
    board = (Part(quad((0, 0, -5), (0.1, 0, 0), (0, 0.1, 0)), Material((0.5, 0.5, 0.5))),)
    bird = WORLDS["bird"].build(0, 10, 0.02)
    return replace(
        bird, static=static, groups={"board": board}, instances={"board": "board"}, deforming={}, emitters=emitters,
        poses=lambda t_s: {"board": np.eye(4)}, exposure=1.0, shadow_sources=np.zeros((0, 4)),
    )  # fmt: skip


def constant(radiance: float) -> dict:
    return {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": [radiance] * 3}}}


def floor_points() -> np.ndarray:
    """Return where the rays through the pixels' centres meet the floor: [H, W, 3]."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    way = CAMERA.unproject(np.stack([u.ravel(), v.ravel()], 1), np.ones(u.size)) - CAMERA.center
    return (CAMERA.center - way * (CAMERA.center[2] / way[:, 2:])).reshape(HEIGHT, WIDTH, 3)


def render(blender: Blender, made: WorldScene, samples: int, check=WORLD) -> np.ndarray:
    """Return the mean [H, W, 3] of both seeds' images."""
    return render_second(blender, check, made, [CAMERA], 0.0, samples)[:, 0].mean(0)


def test_a_matte_floor_in_the_sun(blender):
    direction, irradiance = np.array([0.6, -0.3, -0.7]), np.array([3.0, 2.0, 1.0])
    emitters = {"sun": {"type": "directional", "direction": direction.tolist(), "irradiance": {"value": irradiance}}}
    emitters["sun"]["irradiance"] = {"type": "rgb", "value": irradiance.tolist()}
    image = render(blender, world(emitters, floor=Part(FLOOR, Material((0.4, 0.4, 0.4)))), 1)
    expected = 0.4 / np.pi * irradiance * 0.7 / np.linalg.norm(direction)
    assert image == pytest.approx(np.broadcast_to(expected, image.shape), rel=1e-4)


def test_textures_lie_where_ours_do(blender):
    texels = np.random.default_rng(0).uniform(0.05, 0.9, (8, 8, 3)).astype(np.float32)
    made = world(constant(0.5), floor=Part(quad((0, 0, 0), (3, 0, 0), (0, 3, 0), (2, 1)), Material(texels)))
    theirs, ours = render(blender, made, 256), render_ours(made, [CAMERA], 0.0, 256)[:, 0].mean(0)
    assert np.std(ours) > 0.05
    assert np.abs(gray(theirs) - gray(ours)).max() < 0.02, "the sky at the floor's edge has noise, the floor little"
    assert np.abs(gray(theirs) - gray(ours)).mean() < 0.002


def test_a_lamp_over_a_floor(blender):
    lamp = Lamp(position=(-0.6, 0.4, 1.2), target=(0.2, 0.0, 0.0))
    emitters = {"lamp": lamp.emitters()["lamp"]}
    image = render(blender, world(emitters, floor=Part(FLOOR, Material((0.5, 0.5, 0.5)))), 256)
    steps = (np.arange(60) + 0.5) / 30 - 1
    places = np.stack([*np.meshgrid(steps, steps), np.zeros((60, 60)), np.ones((60, 60))], -1).reshape(-1, 4)
    to_world = np.asarray(emitters["lamp"]["to_world"])
    shining, front = (places @ to_world.T)[:, :3], to_world[:3, 2] / np.linalg.norm(to_world[:3, 2])
    area = 4 * np.linalg.norm(np.cross(to_world[:3, 0], to_world[:3, 1]))
    way = shining - floor_points()[..., None, :]
    square = (way**2).sum(-1)
    cosines = way[..., 2] * np.maximum(-(way @ front), 0) / square  # of the floor and of the lamp
    radiance = np.array(emitters["lamp"]["emitter"]["radiance"]["value"])
    expected = 0.5 / np.pi * area * np.mean(cosines / square, -1)[..., None] * radiance
    seen = np.abs(image / expected - 1)
    assert np.median(seen) < 0.01 and seen.max() < 0.1


def test_a_coat_in_uniform_light(blender):
    for gloss in (0.1, 0.4):
        made = world(constant(0.8), floor=Part(FLOOR, Material((0.6, 0.6, 0.6), gloss)))
        image = gray(render(blender, made, 256))
        way = CAMERA.center - floor_points()
        cosine = way[..., 2] / np.linalg.norm(way, axis=-1)
        layer = np.interp(cosine, np.linspace(0, 1, 64), coat(gloss).weights)
        mirrored = np.array([crossing(gloss, float(c), IOR)[0] for c in cosine[:, WIDTH // 2]])
        expected = 0.8 * (0.6 * layer[:, WIDTH // 2] + mirrored)
        rows = image[:, WIDTH // 2 - 5 : WIDTH // 2 + 5].mean(1)
        assert rows == pytest.approx(expected, rel=0.02)
        assert np.mean(rows / expected) == pytest.approx(1, abs=0.004)


def test_both_renderers_agree_on_grey_boxes(blender):
    static = {
        "floor": Part(FLOOR, Material((0.5, 0.5, 0.5))),
        "box": Part(box((0.5, 0.4, 0.3), (0.1, 0.2, 0.15)), Material((0.7, 0.3, 0.2), 0.2)),
    }
    made = world(Lamp(position=(-0.6, -0.4, 1.5)).emitters(), **static)
    grey = GREY.change(made)
    ours, theirs = render_ours(grey, [CAMERA], 0.0, 1024), render_second(blender, GREY, grey, [CAMERA], 0.0, 1024)
    off = np.mean((gray(ours[0]) - gray(theirs[0])) * (gray(ours[1]) - gray(theirs[1])))
    assert off < 1e-6, "60 dB"
    assert gray(theirs).mean() == pytest.approx(gray(ours).mean(), rel=2e-3)


@pytest.mark.slow
def test_the_report_of_one_world(blender, tmp_path, capsys):
    assert second_renderer(("turntable",), python=blender.python, samples=4, out=tmp_path) == 0
    text = (tmp_path / "second_renderer.md").read_text()
    assert "| turntable | grey | cam_04 |" in text and "| turntable | metal, roughness 0.25 |" in text
    assert "| turntable | sky |" not in text, "a lamp and a room have no map"
    assert (tmp_path / "second_renderer.png").stat().st_size > 10_000
    capsys.readouterr()
    assert second_renderer(("turntable",), python=blender.python, samples=4, out=tmp_path) == 0
    assert (tmp_path / "second_renderer.md").read_text() == text, "all renderings are kept"


def test_a_missing_blender_is_one_clear_error(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError, match="expected an interpreter that has Blender's module bpy.*--python"):
        find_blender(Path(sys.executable))
    with pytest.raises(UserError, match="nowhere, which cannot import it"):
        find_blender(tmp_path / "nowhere")
    assert not os.listdir(tmp_path)


def test_unknown_worlds_are_refused(tmp_path):
    with pytest.raises(UserError, match="worlds: expected some of .*turntable.*found moon"):
        second_renderer(("moon",), out=tmp_path / "out")
    assert not (tmp_path / "out").exists()
