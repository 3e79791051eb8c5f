"""What a loss sees of training images: NaN where nothing was measured at an image's time."""

from dataclasses import replace

import numpy as np
import torch
from splat_scenes import views

from spike4dgs.benchmark.spikes.stream import SpikeStream, pack
from spike4dgs.method.images.intervals import intervals
from spike4dgs.method.training_views.training_images import Spans, TrainingImages


def test_a_span_of_another_time_tells_nothing() -> None:
    """Spans around the image's time, beginning and ending there, at it, after it and before it."""
    spans = [(-6.0, 6.0), (0.0, 9.0), (-9.0, 0.0), (0.0, 0.0), (0.5, 8.0), (-8.0, -0.5)]
    ends = torch.tensor(spans, dtype=torch.float16).T.reshape(1, 1, 2, 1, 6)
    images = TrainingImages(views(1), (20,), torch.full((1, 1, 1, 6), 0.5), 40, spans=Spans(ends, 6.0, 40))
    assert images.measured(0).isnan().flatten().tolist() == [False, False, False, False, True, True]
    assert replace(images, spans=None).measured(0).isfinite().all()


def test_some_views_are_those_of_all() -> None:
    rng = np.random.default_rng(0)
    ends = torch.from_numpy(rng.uniform((-9, -1), (1, 9), (3, 4, 5, 6, 2)).astype(np.float16)).movedim(-1, 2)
    chance = torch.from_numpy(rng.random((4, 5, 6)) < 0.1), torch.from_numpy(rng.random((3, 4)) < 0.3)
    bad, missing = chance
    images = TrainingImages(
        views(4), (20, 30, 40), torch.rand(3, 4, 5, 6), 60, bad=bad, missing=missing, spans=Spans(ends, 6.0, 60)
    )
    assert 0 < images.measured(1).isnan().sum() < 120
    for index in range(3):
        torch.testing.assert_close(
            images.measured(index, [0, 3]), images.measured(index)[[0, 3]], rtol=0, atol=0, equal_nan=True
        )


def test_spans_hold_their_time_but_before_the_first_spike_and_after_the_last() -> None:
    spikes = np.zeros((120, 1, 8), np.uint8)
    fired = np.array([25, 31, 36, 40, 43, 45, 47, 49, 51, 54, 58, 63, 69, 76, 84, 93])  # light that rises and falls
    spikes[fired] = 1
    stream = SpikeStream(pack(spikes), 8, 1, 20_000.0)
    for tick in (5, 20, 26, 50, 90, 96, 115):
        first, last = intervals(stream, tick)[1][:, 0, 0]
        holds = fired[0] + 0.5 <= tick <= fired[-1] + 0.5
        assert (first <= 0 <= last) == holds, (tick, first, last)
