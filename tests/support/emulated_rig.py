"""Emulated arrays that show a small scene, for the tests of cameras and of recordings."""

from spike4dgs.benchmark.scene.scene import Scene
from spike4dgs.generators.recorder.emulation.array import EmulatedArray, scene_profile, scene_streams
from spike4dgs.generators.recorder.emulation.camera import Fault
from spike4dgs.generators.recorder.emulation.ports import EmulatedPort, emulated_ports
from spike4dgs.generators.recorder.rig_profile import RigProfile

BLOCK = 1024
N = 200  # ticks of the clips with faults


def profile_of(scene: Scene, **changes: object) -> RigProfile:
    # The time limit is for a busy machine.
    return scene_profile(scene, **({"transfer_bytes": BLOCK, "transfers": 4, "timeout_ms": 20000} | changes))


def emulate(scene: Scene, profile: RigProfile, *faults: Fault, **options: object) -> list[EmulatedPort]:
    return emulated_ports(EmulatedArray(profile, scene_streams(scene), faults=faults, **options))  # type: ignore[arg-type]
