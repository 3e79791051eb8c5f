"""Scene generation: Mitsuba worlds, camera rig, key frames, the spike simulator, and the recorder of the real array."""

from typing import TYPE_CHECKING

from spike4dgs.benchmark.lazy import lazy_names

if TYPE_CHECKING:
    from spike4dgs.generators.profiles import PROFILES, Profile
    from spike4dgs.generators.scene_maker import Maker
    from spike4dgs.generators.sensor.model import Sensor, simulate
    from spike4dgs.generators.worlds import WORLDS, World, WorldScene
else:
    __getattr__, __dir__ = lazy_names(
        __name__,
        {
            "profiles": ("PROFILES", "Profile"),
            "scene_maker": ("Maker",),
            "sensor.model": ("Sensor", "simulate"),
            "worlds": ("WORLDS", "World", "WorldScene"),
        },
    )

__all__ = ["PROFILES", "WORLDS", "Maker", "Profile", "Sensor", "World", "WorldScene", "simulate"]
