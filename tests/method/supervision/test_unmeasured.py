"""Losses on spikes leave out what was not measured: bad pixels and long gaps."""

import math
from dataclasses import replace

import pytest
import torch
from toy_world import ToyWorld

from spike4dgs.baselines.spike_render import SpikeRender
from spike4dgs.benchmark.scene.camera_state import CameraState
from spike4dgs.benchmark.spikes.gaps import Gap
from spike4dgs.method.supervision.base import Sample, difference
from spike4dgs.method.supervision.spike import SpikeRate
from spike4dgs.method.supervision.spike_cameras import SpikeCameras, recorded
from spike4dgs.method.supervision.spss import SpikeVariation

SCENE = ToyWorld(width=24, height=16, side=2, n_ticks=60).training


VIEWS = (0, 2)


def gradient(kind, scene):
    """The gradient of a loss in the renders [2, H, W] of the views."""
    rendered = torch.full((2, 16, 24), 0.4, requires_grad=True)
    loss = kind(kind.defaults, scene)(lambda t: rendered, Sample(0.5, 30, VIEWS, torch.full((2, 16, 24), 0.5), 0))
    loss.backward()
    return rendered.grad


@pytest.mark.parametrize("kind", [SpikeRate, SpikeVariation])
def test_an_unmeasured_pixel_pulls_at_nothing_and_changes_nothing_else(kind):
    unmeasured = torch.zeros(2, 16, 24, dtype=torch.bool)
    unmeasured[0, 3, 4] = unmeasured[1, 10, 20] = True
    names = [SCENE.cameras[view].id for view in VIEWS]
    states = {name: CameraState(bad=mask.numpy()) for name, mask in zip(names, unmeasured, strict=True)}
    whole, found = gradient(kind, SCENE), gradient(kind, replace(SCENE, states=states))
    assert (found[unmeasured] == 0).all() and (whole[unmeasured] != 0).all()
    assert torch.equal(found[~unmeasured], whole[~unmeasured])


def test_a_view_in_a_gap_leaves_the_loss_finite():
    gap = Gap(SCENE.cameras[2].id, 10, 45, "overflow")
    streams = (*SCENE.streams[:2], replace(SCENE.streams[2], gaps=(gap,)), *SCENE.streams[3:])
    scene = replace(SCENE, streams=streams)
    for kind in (SpikeRate, SpikeVariation, SpikeRender):
        assert gradient(kind, scene).isfinite().all()
    counts, ticks = recorded(scene, Sample(0.5, 30, VIEWS, torch.full((2, 16, 24), 0.5), 0), 40)
    assert ticks == 40 and counts[0].isfinite().all() and counts[1].isnan().all()


def test_a_cameras_gain_is_part_of_its_response():
    name = SCENE.cameras[1].id
    scene = replace(SCENE, states={name: CameraState(gain=1.1)})
    image = torch.full((2, 16, 24), 0.5)
    plain, own = (SpikeCameras(s).rate(image, (0, 1)) for s in (SCENE, scene))
    assert torch.equal(own[0], plain[0])
    torch.testing.assert_close(own[1], 1.1 * plain[1])


def test_unknown_pixels_have_no_gradient_and_known_ones_have_theirs() -> None:
    generator = torch.Generator().manual_seed(0)
    image = torch.rand(2, 24, 30, generator=generator)
    rendered = torch.rand(2, 24, 30, generator=generator).requires_grad_(True)
    unknown = torch.zeros(2, 24, 30, dtype=torch.bool)
    unknown[:, :, 22:] = True
    difference(rendered, image.masked_fill(unknown, math.nan), 0.2).backward()
    part = rendered.grad.clone()
    assert (part[unknown] == 0).all() and (part[~unknown] != 0).all()
    rendered.grad = None
    difference(rendered, image, 0.2).backward()
    far = torch.zeros_like(unknown)
    far[:, :, : 22 - 11] = True  # further than SSIM's window from what is unknown
    torch.testing.assert_close(part[far], rendered.grad[far])
