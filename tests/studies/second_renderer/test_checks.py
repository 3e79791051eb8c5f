"""The changed worlds of the checks, and what is measured on their images."""

import numpy as np
import pytest

from spike4dgs.generators.rendering.mitsuba_variant import load_mitsuba
from spike4dgs.generators.rig import cameras
from spike4dgs.generators.worlds import WORLDS
from spike4dgs.studies.second_renderer.checks import CHECKS, flush, glossy, overcast, plain, smooth, textured, unchanged
from spike4dgs.studies.second_renderer.comparison import compare, decibels, kind_of, kinds, ratios
from spike4dgs.studies.second_renderer.export import surfaces_at
from spike4dgs.studies.second_renderer.renderings import kept

T_S = 0.01


@pytest.fixture(scope="module")
def turntable():
    return WORLDS["turntable"].build(0, 10, 0.02)


def planes(world) -> np.ndarray:
    """Return unit normal and offset [M, 4] of every face of the window frames of the street."""
    mesh = world.static["frames"].mesh
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.c_[normal, (normal * corners[:, 0]).sum(1)]


def test_pieces_that_lie_in_one_plane_are_moved_apart():
    street = WORLDS["car"].build(0, 10, 0.02)
    there, apart = planes(flush(street)), planes(plain(street))
    assert np.abs(there[:, :3] - apart[:, :3]).max() < 1e-9, "nothing turns"
    assert len(np.unique(there[:, 3].round(7))) < 0.1 * len(there), "bars of one frame share planes"
    assert len(np.unique(apart[:, 3].round(7))) > 0.45 * len(apart), "the two triangles of a side stay together"
    assert np.abs(there[:, 3] - apart[:, 3]).max() < 1e-3


@pytest.mark.parametrize("change", [plain, flush, smooth, textured, glossy, overcast, unchanged])
def test_a_change_leaves_what_it_is_not_about(turntable, change):
    before, after = (list(surfaces_at(world, T_S)) for world in (turntable, change(turntable)))
    assert [s.name for s in before] == [s.name for s in after]
    assert all(np.abs(a.mesh.vertices - b.mesh.vertices).max() < 1e-3 for a, b in zip(before, after, strict=True))
    assert all(np.array_equal(a.mesh.uv, b.mesh.uv) for a, b in zip(before, after, strict=True))
    kept_gloss = [a.material.gloss == b.material.gloss for a, b in zip(before, after, strict=True)]
    assert all(kept_gloss) == (change in (glossy, overcast, unchanged))
    assert any(s.mesh.smooth for s in after) == (change in (smooth, unchanged))


def test_a_check_applies_where_the_world_has_what_it_is_about(turntable):
    sky = next(check for check in CHECKS if check.id == "sky")
    assert sky.applies(WORLDS["bird"].build(0, 10, 0.02)) and not sky.applies(turntable)
    known = {check.id for check in CHECKS}
    assert len(known) == len(CHECKS) and {check.ours for check in CHECKS} <= known | {""}


def test_a_difference_is_found_below_the_noise():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.1, 0.9, (100, 120, 1)).repeat(3, 2).astype(np.float32)
    moving = np.zeros((100, 120), bool)
    moving[:, :40] = True
    noise = rng.normal(0, 0.02, (4, 100, 120, 1)).astype(np.float32)
    second = truth + np.where(moving, 0.01, 0.0)[..., None].astype(np.float32)
    found = compare(truth + noise[:2], second + noise[2:], moving)
    assert (
        found["moving"]["difference"].value == pytest.approx(40, abs=0.5) and not found["moving"]["difference"].at_least
    )
    assert found["static"]["difference"].at_least and found["static"]["difference"].value > 44
    assert found["whole"]["noise_db"] == pytest.approx([34, 34], abs=0.2)
    assert str(found["static"]["difference"]).startswith("> ")


def test_decibels_of_known_squares():
    assert decibels(np.full(1000, 1e-4, np.float32)).value == pytest.approx(40, abs=1e-3)


def test_a_pixel_belongs_to_the_material_that_fills_it(turntable):
    if load_mitsuba().variant().startswith("scalar"):
        pytest.skip("the painted world is rendered with a variant that compiles kernels")
    camera = cameras(turntable, 100, 62, (4,))[0]
    found = kinds(turntable, camera, T_S)
    assert set(found) == {kind_of(s.material) for s in surfaces_at(turntable, T_S)}
    total = sum(mask.astype(int) for mask in found.values())
    assert total.max() == 1 and total.mean() > 0.7, "edges belong to none"
    for point, kind in (((0.0, 0.0, 0.125), "metal, roughness 0.25"), ((-0.45, 0.0, 0.0), "coat, roughness 0.25")):
        column, row = camera.project(np.array([point]))[0][0].astype(int)
        assert found[kind][row, column]
    flat = np.full((2, 62, 100, 3), 0.5, np.float32)
    painted = flat * np.where(found["metal, roughness 0.25"], 1.5, 0.9)[..., None]
    seen = ratios(flat, painted, found)
    assert seen["metal, roughness 0.25"]["median_ratio"] == pytest.approx(1.5)
    assert seen["matte"]["median_ratio"] == pytest.approx(0.9)


def test_a_rendering_is_kept_for_the_same_key_alone(tmp_path):
    made = []

    def make() -> np.ndarray:
        made.append(1)
        return np.full((2, 3), len(made), np.float32)

    path = tmp_path / "a.npz"
    assert kept(path, {"samples": 1}, make)[0, 0] == 1
    assert kept(path, {"samples": 1}, make)[0, 0] == 1
    assert kept(path, {"samples": 2}, make)[0, 0] == 2
    cut = path.read_bytes()[:-20]
    for count, damaged in enumerate((b"damaged", b"", cut), start=3):
        path.write_bytes(damaged)
        assert kept(path, {"samples": 2}, make)[0, 0] == count
