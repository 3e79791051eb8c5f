"""Scenes that differ by what cameras and light make of a rendering alone: it is rendered once for all of them."""

from __future__ import annotations

import os
import shutil
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from spike4dgs.benchmark.files import locked
from spike4dgs.generators.physics import Physics
from spike4dgs.generators.profiles import Job
from spike4dgs.generators.scene_maker import Maker, work_key

# The physics that change no radiance, and of ground truth the light alone. A new one is shared once it stands here.
AFTERWARDS = (
    "pose_noise_deg",
    "pose_noise_m",
    "flicker",
    "flicker_hz",
    "flicker_duty",
    "warming_k",
    "reset_noise",
    "read_noise",
    "dead_ticks",
    "clock_ripple",
    "light",
    "lost_ticks",
    "noisy_others",
)


def rendering_of(job: Job) -> Job:
    """Return a job that stands for all jobs of its rendering."""
    without: dict[str, Any] = {f.name: f.default for f in fields(Physics) if f.name in AFTERWARDS}
    return replace(job, physics=replace(job.physics, **without), gain_map=True, dark_map=True, shot_noise=True)


_WAIT_S = 600.0  # while another process copies a rendering, of some GB
# Of `scene/`: what cameras and their light make, which every scene has of its own.
_OWN = ("spikes", "calibration", "conventional", "events", "truth")


@dataclass
class SharingMaker(Maker):
    """A maker that takes the rendering of its scene from OUT/.work, or leaves it there for the next one.

    Who makes the last scene of a rendering calls `forget`.
    """

    def _open_work(self) -> None:
        with self._alone():
            if self._shared.is_dir() and not self._work.exists():
                self._copy(self._shared, self._work)
        super()._open_work()

    def _simulate(self) -> None:
        with self._alone():
            if not self._shared.exists():
                self._copy(self._work, self._shared)
        super()._simulate()

    def forget(self) -> None:
        """Remove what scenes of this rendering share."""
        with self._alone():
            shutil.rmtree(self._shared, ignore_errors=True)
        with suppress(OSError):  # another process still has files there, or was the last
            self._shared.parent.rmdir()

    @property
    def _shared(self) -> Path:
        key = work_key(rendering_of(self.job).settings, self._versions)
        return self.out / ".work" / f"rendering-{key[:12]}"

    def _alone(self) -> AbstractContextManager[None]:
        """Keep other processes, which make other scenes of this rendering, off what is shared."""
        expected = "a rendering that nobody else copies"
        return locked(self._shared.with_suffix(".lock"), self._shared, expected, _WAIT_S, temporary=True)

    @property
    def _bytes_needed(self) -> float:
        return super()._bytes_needed * (1 if self._shared.exists() else 2)  # its own, and what it leaves for others

    def _copy(self, source: Path, destination: Path) -> None:
        """Copy the files of a work folder elsewhere: keys, backgrounds and, where the light is steady, ground truth."""
        left_out = ["settings.json", *_OWN, *(["scene"] if self.job.flicker else [])]
        part = destination.with_name(f"{destination.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        shutil.copytree(source, part, ignore=shutil.ignore_patterns(*left_out))
        os.rename(part, destination)
