"""The pace of a clip: motion measured in images drawn in closed form, and what follows from it."""

import math
from dataclasses import replace

import pytest
import torch
from splat_scenes import views
from torch import Tensor

from spike4dgs.method.images.intervals import INTERVALS, IntervalSettings
from spike4dgs.method.images.training import ImageSettings
from spike4dgs.method.motion.base import Extent
from spike4dgs.method.motion.paths import Paths, PathSettings
from spike4dgs.method.motion.polynomial import PolynomialSettings
from spike4dgs.method.pace import MOST_PX, at_pace, fast_motion
from spike4dgs.method.splat import Views
from spike4dgs.method.torch_state import seeded
from spike4dgs.method.training_views.training_images import TrainingImages

VIEWS = views(3)
SIZE = VIEWS.height, VIEWS.width


def texture(shift: float) -> Tensor:
    """Return a smooth texture [H, W] that has moved by so many px, four parts right and three down of five."""
    y, x = torch.meshgrid(torch.arange(float(SIZE[0])), torch.arange(float(SIZE[1])), indexing="ij")
    x, y = x - 0.8 * shift, y - 0.6 * shift
    waves = torch.sin(0.45 * x + 0.1 * y) + torch.sin(0.12 * x - 0.4 * y + 1) + torch.sin(0.3 * x + 0.3 * y + 2)
    return 0.5 + 0.14 * waves


def clip(px: float, count: int = 9, moving: slice = slice(None)) -> TrainingImages:
    """Return images in which the columns `moving` move by `px` from each to the next, with a little noise."""
    images = texture(0).repeat(count, len(VIEWS), 1, 1)
    for k in range(count):
        images[k, :, :, moving] = texture(px * k)[:, moving]
    noise = 0.004 * torch.randn(images.shape, generator=torch.Generator().manual_seed(0))
    return TrainingImages(VIEWS, tuple(range(10, 10 * count + 1, 10)), images + noise, 10 * count + 10)


@pytest.mark.parametrize("px", [0.4, 1.0, 2.5])
def test_motion_is_measured_where_something_moves(px: float) -> None:
    assert 10 * fast_motion(clip(px)) == pytest.approx(px, rel=0.1)
    assert 10 * fast_motion(clip(px, moving=slice(10, 45))) == pytest.approx(px, rel=0.15)


def test_what_rests_or_only_changes_its_light_has_no_pace() -> None:
    assert 10 * fast_motion(clip(0.0)) == 0
    still = clip(0.0)
    factors = 1 + 0.05 * torch.sin(torch.arange(9.0))
    assert 10 * fast_motion(replace(still, images=still.images * factors[:, None, None, None])) < 0.5


def test_too_few_or_tiny_images_tell_nothing() -> None:
    assert 10 * fast_motion(clip(2.0, count=2)) == 0
    tiny = Views(VIEWS.w2c, VIEWS.K, 11, 40)
    assert 10 * fast_motion(TrainingImages(tiny, (1, 2, 3), torch.rand(3, 3, 40, 11), 10)) == 0


def test_motion_is_measured_beside_a_gap_of_all_cameras() -> None:
    images = clip(2.5, count=7)
    missing = torch.zeros(7, len(VIEWS), dtype=torch.bool)
    missing[3] = True  # of each of the three trios
    assert 10 * fast_motion(replace(images, missing=missing)) == pytest.approx(2.5, rel=0.1)
    assert fast_motion(replace(images, missing=torch.ones_like(missing))) == 0


def settings(in_pace: bool = True) -> dict[str, object]:
    return {"images": ImageSettings(time_spacing_ticks=10), "motion": PathSettings(in_pace=in_pace)}


@pytest.mark.parametrize(("px", "pace"), [(0.5, 1.0), (2.5, 2.5)])
def test_images_follow_what_is_fast(px: float, pace: float, capsys: pytest.CaptureFixture[str]) -> None:
    asked = []

    def make(maker, images):  # type: ignore[no-untyped-def]
        asked.append((maker.settings.half, images.time_spacing_ticks))
        return clip(px * images.time_spacing_ticks / 10)

    images, changed, found = at_pace("scene", INTERVALS, settings(), make)
    assert found == pytest.approx(pace, rel=0.1)
    assert 10 * fast_motion(images) <= MOST_PX * 1.1
    if pace == 1:
        assert asked == [(6.0, 10)] and changed == settings() and not capsys.readouterr().err
    else:
        assert asked == [(6.0, 10), (pytest.approx(6 / pace, rel=0.1), 4)]
        assert changed["images"] == ImageSettings(time_spacing_ticks=4)
        assert "scene: fast motion, 2.5 px" in capsys.readouterr().err


@pytest.mark.parametrize("motion", [PathSettings(in_pace=False), PolynomialSettings()])
def test_other_motions_take_their_images_as_they_are(motion: PolynomialSettings) -> None:
    asked = []
    given = {**settings(), "motion": motion}
    found = at_pace("scene", INTERVALS, given, lambda maker, images: asked.append(maker) or clip(3.0))
    assert len(asked) == 1 and found[1:] == (given, 1.0)


def test_spans_are_never_shorter_than_the_shortest() -> None:
    assert IntervalSettings().denser(2).half == 3
    assert IntervalSettings().denser(100) == replace(IntervalSettings(), half=IntervalSettings().shortest)
    assert ImageSettings(time_spacing_ticks=10).denser(100).time_spacing_ticks == 1


@pytest.mark.parametrize(
    ("n_ticks", "pace", "images", "pieces"),
    [
        (400, 1.0, math.inf, 1),
        (400, 1.2, math.inf, 3),  # no piece sees more motion than one of 20 ms at the usual pace
        (400, 3.3, math.inf, 5),
        (100, 3.3, math.inf, 1),
        (1000, 1.0, math.inf, 3),
        (1000, 2.0, math.inf, 5),
        (400, 8.0, 100, 5),  # as many images in each as ever
    ],
)
def test_pieces_are_as_much_shorter_as_motion_is_faster(n_ticks: int, pace: float, images: float, pieces: int) -> None:
    extent = Extent(torch.zeros(3), torch.ones(3), 1.0, n_ticks, 64, images, pace)
    assert Paths(extent, PathSettings(), seeded(0, 0)).pieces == pieces
