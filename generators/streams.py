"""Recordings of each camera: its spikes, its calibration recordings, and those of other sensors at the same position.

One call writes all recordings of one camera, the spikes last.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from spike4dgs.benchmark.scene.cameras import Camera
from spike4dgs.benchmark.scene.images import encode_srgb, write_png
from spike4dgs.benchmark.scene.other_sensors import write_events
from spike4dgs.benchmark.scene.scene import Target
from spike4dgs.benchmark.scene.writer import stream_name
from spike4dgs.benchmark.spikes.gaps import Gap, present
from spike4dgs.benchmark.spikes.sensor_model import SENSOR
from spike4dgs.benchmark.spikes.stream import SpikeWriter
from spike4dgs.generators.other_sensors import (
    EXPOSURE_S,
    FPS,
    THRESHOLD,
    EventNoise,
    FrameNoise,
    events,
    exposures,
    noisy_frame,
)
from spike4dgs.generators.profiles import RATE_HZ, Job
from spike4dgs.generators.rendering.image_motion import KeyPlan
from spike4dgs.generators.rendering.keyframes import Clip, KeyStore
from spike4dgs.generators.sensor import calibration as calibration
from spike4dgs.generators.sensor.calibration import dark_map, gain_map, write_maps
from spike4dgs.generators.sensor.light import FlickeringInstants, FlickeringMeans
from spike4dgs.generators.sensor.model import Sensor, random_charge, simulate

# of the physics, where they are on
_OF_SENSOR = ("psf_px", "warming_k", "reset_noise", "read_noise", "dead_ticks", "clock_ripple")
CALIBRATION_TICKS = calibration.FLAT_TICKS + calibration.DARK_TICKS


def is_done(scene: Path, camera: Camera) -> bool:
    """Return whether `write_camera` has finished for this camera."""
    return (scene / stream_name(camera.id)).is_file()


def write_camera(scene: Path, job: Job, camera: Camera, store: KeyStore, view: int, plan: KeyPlan) -> None:
    """Write truth maps, calibration recordings, conventional frames, events and spikes of one camera."""
    sensor = sensor_of(job, camera)
    warm = sensor if sensor.dark is None else replace(sensor, dark=sensor.dark * np.float32(job.physics.dark_factor))
    size, entropy = (camera.height, camera.width), [job.seed, job.variant, *f"{job.world} {camera.id}".encode()]
    write_maps(scene / f"truth/{camera.id}.npz", {"gain": sensor.gain, "dark": sensor.dark})
    calibration.write_calibration(scene / "calibration", camera, sensor, entropy)
    # In flicker the light at the start of each tick tells too little of a frame: some lamps flicker as fast as ticks.
    exposed = _lit(job, store, view, plan)[1 if job.flicker else 0]
    noisy, light, rng = (
        job.physics.noisy_others,
        np.float32(job.physics.light),
        np.random.default_rng([*entropy, *b"others"]),
    )
    for tick, image in exposures(exposed.keys, exposed.ticks, job.n_ticks, RATE_HZ, exposed.means):
        shown = noisy_frame(image * light, FrameNoise(), rng) / light if noisy else image
        write_png(scene / f"conventional/{Target(camera.id, tick).name}.png", encode_srgb(shown))
    noise, (instants, clip) = EventNoise() if noisy else None, _lit(job, store, view, plan)
    found = events(instants.keys, instants.ticks, job.n_ticks, RATE_HZ, noise=noise, rng=rng)
    write_events(scene / f"events/{camera.id}.npz", found)
    charge, there, start = random_charge(*size, entropy), present(gaps_of(job, camera), job.n_ticks), 0
    with SpikeWriter(scene / stream_name(camera.id), camera.width, camera.height) as writer:
        for packed in simulate(clip.keys, clip.ticks, job.n_ticks, warm, charge, means=clip.means):
            packed[~there[start : start + len(packed)]] = 0
            writer.write(packed)
            start += len(packed)


def gaps_of(job: Job, camera: Camera) -> list[Gap]:
    """Return the runs of ticks that a camera loses: a function of the seed, the world and the camera."""
    rng = np.random.default_rng([job.seed, job.variant, *f"{job.world} {camera.id} lost".encode()])
    lost = rng.random(job.n_ticks) < job.physics.lost_ticks
    edges = np.flatnonzero(np.diff(lost, prepend=False, append=False)).tolist()
    return [Gap(camera.id, a, b - a, "lost") for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _lit(job: Job, store: KeyStore, view: int, plan: KeyPlan) -> tuple[Clip, Clip]:
    """Return the radiance of a view at instants, and as the simulator takes it, in the light that the world has."""
    instants, clip, light = store.instants(view, plan), store.view(view, plan), job.flicker
    if light is None:
        return instants, clip
    n, means = job.n_ticks, clip.keys if clip.means else None
    dense = FlickeringInstants(store.at(view, plan), n, light)
    every = list(range(n + 1))
    return Clip(dense, every), Clip(FlickeringMeans(store.at(view, plan), n, light, means), every[:-1], True)


def radiance_gain(job: Job) -> float:
    """Return the spikes per tick of a pixel that sees radiance 1."""
    return SENSOR.radiance_gain * job.physics.light


def sensor_of(job: Job, camera: Camera) -> Sensor:
    """Return a camera's sensor as it is calibrated; its maps belong to the camera, not to the world."""
    pixels = camera.height, camera.width, job.seed, camera.id
    return Sensor(
        gain=gain_map(*pixels) if job.gain_map else None,
        dark=dark_map(*pixels) if job.dark_map else None,
        photons=SENSOR.photons_per_spike if job.shot_noise else None,
        radiance_gain=radiance_gain(job),
        noise_seed=(job.seed, job.variant, *f"{job.world} {camera.id} photons".encode()),
        reset_noise=job.physics.reset_noise,
        read_noise=job.physics.read_noise,
        dead_ticks=job.physics.dead_ticks,
        clock_ripple=job.physics.clock_ripple,
    )


def sensor_facts(job: Job) -> dict[str, Any]:
    """Return `sensor` of scene.json."""
    return {
        **calibration.noisy_facts(),
        "gain_map": job.gain_map,
        "dark_map": job.dark_map,
        "photons_per_spike": SENSOR.photons_per_spike if job.shot_noise else None,
        **{name: value for name, value in job.physics.settings.items() if name in _OF_SENSOR},
    }


def extras(job: Job) -> dict[str, dict[str, Any]]:
    """Return the entries of scene.json about the files that `write_camera` and the ground truth add."""
    noisy = job.physics.noisy_others
    frames, noise = ({"noise": asdict(n)} if noisy else {} for n in (FrameNoise(), EventNoise()))
    return {
        "ground_truth": {
            "images": "linear radiance, half float: R, G, B and gray Y; 1 is white",
            "geometry": "Z: metres along the optical axis; id: see instances; flow.x, flow.y: px to 1 ms later",
            "sparse_every_ticks": job.profile.sparse_every,
        },
        "conventional": {"fps": FPS, "exposure_s": EXPOSURE_S, "coding": "8-bit sRGB gray"} | frames,
        "events": {"threshold": THRESHOLD, "columns": "t (us), x, y, p (1: brighter)"} | noise,
        "calibration": calibration.calibration_facts(radiance_gain(job)),
    }
