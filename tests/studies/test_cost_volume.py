"""The cost volume on features that are a function of the point: a slanted plane whose depth is known."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from spike4dgs.method.matching.adjust import Array
from spike4dgs.studies.poses.cost_volume import CellDepths, best_depths, cell_scores

ROWS, COLUMNS, CHANNELS = 30, 40, 24
SIZE = (60, 80)  # px of the images: no cell is padding
NORMAL, OFFSET = np.array([0.25, -0.1, 1.0]), 4.0  # the plane n x = 4


def rays(array: Array, view: int) -> np.ndarray:
    v, u = np.mgrid[:ROWS, :COLUMNS] * 2 + 1.0
    return np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(array.K[view]).T


def true_inverse(array: Array, view: int) -> np.ndarray:
    """1 / z of the plane in a view: n (c + z R^T d) = 4."""
    along = rays(array, view) @ array.R[view] @ NORMAL
    return np.asarray(along / (OFFSET - array.centers[view] @ NORMAL))


def features(array: Array) -> torch.Tensor:
    """Sines of the point on the plane, of several directions and phases: a product is largest at the same point."""
    rng = np.random.default_rng(0)
    waves, phases = rng.normal(0, 3, (CHANNELS, 3)), rng.uniform(0, 6, CHANNELS)
    found = []
    for view in range(len(array.R)):
        z = 1 / true_inverse(array, view)
        points = (rays(array, view) * z[..., None]) @ array.R[view] + array.centers[view]
        found.append(np.sin(points @ waves.T + phases).transpose(2, 0, 1))
    return torch.from_numpy(np.stack(found)).float()


def cell_depths(fine: torch.Tensor, size: tuple[int, int], array: Array, planes: np.ndarray) -> CellDepths:
    return best_depths(cell_scores(fine, size, array, 0, planes), planes)


def test_a_planes_depth_is_found_and_what_is_sure_is_right() -> None:
    K = np.array([[70.0, 0, 40], [0, 70.0, 30], [0, 0, 1]])
    turns = Rotation.from_rotvec([(0, 0, 0), (0, -0.05, 0.02), (0.05, 0, 0), (0.0, 0.06, 0)]).as_matrix()
    centers = np.array([(0, 0, 0), (0.9, 0, 0), (0, 0.9, 0.1), (-0.9, 0.1, 0)])
    array = Array(turns, centers, np.tile(K, (4, 1, 1)))
    true = true_inverse(array, 0)
    planes = np.linspace(0.85 * true.min(), 1.15 * true.max(), 48)
    found = cell_depths(features(array), SIZE, array, planes)
    inside = (slice(6, -6), slice(6, -6))
    off = np.abs(found.inverse / true - 1)
    assert np.median(off[inside]) < 0.01 and np.mean(off[inside] < 0.03) > 0.9
    assert found.confidence.min() >= 0 and found.confidence.max() <= 1
    # Features that tell nothing are less sure, cell by cell, than those of the plane.
    noise = cell_depths(torch.randn(4, CHANNELS, ROWS, COLUMNS), SIZE, array, planes)
    assert np.median(noise.confidence) < 0.6 * np.median(found.confidence[inside])


def test_what_one_view_alone_sees_has_no_confidence() -> None:
    K = np.array([[70.0, 0, 40], [0, 70.0, 30], [0, 0, 1]])
    away = Rotation.from_rotvec([(0, 0, 0), (0, 3.0, 0), (0, 3.0, 0)]).as_matrix()
    array = Array(away, np.array([(0, 0, 0), (0.5, 0, 0), (0, 0.5, 0)]), np.tile(K, (3, 1, 1)))
    found = cell_depths(torch.randn(3, 4, ROWS, COLUMNS), SIZE, array, np.linspace(0.1, 0.5, 8))
    assert (found.confidence == 0).all()


def test_padding_beyond_the_image_sees_nothing() -> None:
    """The other two views see the first one's cells 5.6 px or more to the right."""
    K = np.array([[70.0, 0, 40], [0, 70.0, 30], [0, 0, 1]])
    centers = np.array([(0, 0, 0), (-0.1, 0, 0), (-0.1, 0, 0)])
    array = Array(np.tile(np.eye(3), (3, 1, 1)), centers, np.tile(K, (3, 1, 1)))
    fine, planes = torch.ones(3, 4, ROWS, COLUMNS), np.array([0.8, 1.0, 1.2])
    whole, cut = (cell_depths(fine, size, array, planes).confidence for size in (SIZE, (60, 70)))
    seen = np.arange(COLUMNS) * 2 + 1 + 0.8 * 0.1 * 70
    np.testing.assert_array_equal(whole > 0, np.tile(seen < 80, (ROWS, 1)))
    np.testing.assert_array_equal(cut > 0, np.tile(seen < 70, (ROWS, 1)))
