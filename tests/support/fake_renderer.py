"""A renderer without Mitsuba, and the files of a folder, for the tests of `make-dataset`."""

from functools import cache
from types import SimpleNamespace

import numpy as np

from spike4dgs.benchmark.scene.images import gray
from spike4dgs.generators import render_tasks, scene_maker
from spike4dgs.generators.profiles import PROFILES
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.render import StaticViews
from spike4dgs.generators.worlds import WORLDS

PLAN = KeyPlan(80, 20_000, 0.5, (20, 10))


@cache
def car():
    return WORLDS["car"].build(0, 0, PROFILES["tiny"].seconds)


def render_fakes(monkeypatch, sheets=False):
    """Let `make-dataset` render scenes of the profile tiny with the FakeRenderer; the rest of it is real.

    Without `sheets` a scene's sheet, which takes most of its time, is a file of some bytes.
    """
    monkeypatch.setattr(render_tasks, "world_of", lambda job: car())
    monkeypatch.setattr(render_tasks, "plan_of", lambda job: PLAN)
    monkeypatch.setattr(render_tasks, "path_renderer", FakeRenderer)
    monkeypatch.setattr(scene_maker, "load_mitsuba", lambda: SimpleNamespace(variant=lambda: "fake"))
    if not sheets:
        monkeypatch.setattr(scene_maker, "contact_sheet", lambda scene, path: path.write_bytes(b"no sheet"))


class FakeRenderer:
    """Images without Mitsuba: a bright square over noise, to the right with time."""

    def __init__(self, world, cameras, *, seed, spp, background_spp, color=False, static=None, **_options):
        self.cameras, self.color = tuple(cameras), color
        self.shape = (len(cameras), cameras[0].height, cameras[0].width)
        noise = [
            np.random.default_rng([0, *c.id.encode()]).uniform(0.2, 0.4, self.shape[1:]).astype(np.float32)
            for c in cameras
        ]
        self.static = static or StaticViews(*np.repeat(np.stack(noise)[None, ..., None], 2, 0).repeat(3, -1))

    def static_at(self, pixels, background=True):
        image = self.static.background.reshape(-1, 3)[pixels]
        return (image, image) if background else (image,)

    def object_masks(self, t_s):
        x = np.arange(self.shape[2]) - 10 - 5000 * t_s
        return np.broadcast_to((np.abs(x) < 5) & (np.abs(np.arange(self.shape[1]) - 20) < 6)[:, None], self.shape)

    traced = moving_masks = object_masks

    def keys(self, t_s):
        rgb = np.where(self.object_masks(t_s)[..., None], np.float32(0.9), self.static.background)
        return rgb if self.color else gray(rgb)

    reference_frames = None

    def key_arrays(self, tick, plan):
        mask = self.object_masks(tick / 20_000)
        given = {f"given{v}": np.packbits(m) for v, m in enumerate(mask)}
        values = gray(np.full(3, 0.9, np.float32))
        return given | {f"values{v}": np.full(m.sum(), values, np.float32) for v, m in enumerate(mask)}

    def depths(self, t_s):
        return np.full(self.shape, 5.0, np.float32)

    def geometry(self, t_s, dt_s):
        flow = np.zeros((*self.shape, 2), np.float32)
        return self.depths(t_s), self.object_masks(t_s).astype(np.uint32), flow
