"""What the clients open, made by the commands that a user runs, and the same values by our own code.

    INPUTS/scene/            a scene folder without Mitsuba: four cameras, a pattern that drifts
    INPUTS/spikecv/...       export-spikecv, where SpikeCV looks for its data sets: ../spkData/datasets from work/
    INPUTS/nerfstudio/       export-nerfstudio        INPUTS/colmap/    export-colmap
    INPUTS/ply/              export-ply of a model    INPUTS/images.npz pairs of truth and prediction
    INPUTS/points.npy, pixels.npy                     points [N, 3] that are projected, pixels [N, 2] that see rays

The other functions take this folder and return {value: numbers}; the script of a client returns the same names.
"""

import contextlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from saved_models import model, provenance
from small_scenes import write_small_scene

from spike4dgs.baselines.images.table import IMAGES
from spike4dgs.benchmark import METRICS, Scene, Target, open_scene
from spike4dgs.benchmark.exchange.recording import Recording
from spike4dgs.benchmark.exchange.spikecv import import_spikecv
from spike4dgs.benchmark.metrics.image_pair import ImagePair
from spike4dgs.benchmark.scene.images import encode_srgb
from spike4dgs.benchmark.spikes.stream import pack
from spike4dgs.cli import main
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.splat.types import ALPHA_MIN
from spike4dgs.method.viewing.ply import srgb

Values = dict[str, list[float]]

FRAMES = 4  # .ply files
SAMPLE = "recVidarReal2019/classA/ballon.dat"  # SpikeCV publishes its description, config.yaml, without the stream


def make_inputs(root: Path) -> None:
    """Write what the clients open into a new folder."""
    write_small_scene(root / "scene")
    model("hexplane, background").save(root / "model.safetensors", provenance())
    (root / "spikecv/work").mkdir(parents=True)
    for command in (
        f"export-spikecv {root}/scene --out {root}/spikecv/spkData/datasets",
        f"export-nerfstudio {root}/scene --out {root}/nerfstudio",
        f"export-colmap {root}/scene --out {root}/colmap",
        f"export-ply {root}/model.safetensors --out {root}/ply --times {FRAMES}",
    ):
        with contextlib.redirect_stdout(io.StringIO()):
            done = main(command.split())
        if done != 0:
            raise SystemExit(f"`spike4dgs {command}` failed")
    rng = np.random.default_rng(0)
    np.save(root / "points.npy", rng.uniform(-0.8, 0.8, (20, 3)))
    np.save(root / "pixels.npy", rng.uniform(0, 24, (20, 2)))
    truth = rng.random((4, 48, 64))
    noise = np.array([0.5, 0.1, 0.02, 0.004])[:, None, None]
    np.savez(root / "images.npz", truth=truth, prediction=np.clip(truth + noise * rng.normal(size=truth.shape), 0, 1))


def add_sample(root: Path, checkout: Path) -> None:
    """Copy the description of one of SpikeCV's own data sets, and put a stream of its size where its own lies."""
    stream = root / "spikecv/spkData/datasets" / SAMPLE
    stream.parent.mkdir(parents=True)
    description = checkout / "SpikeCV/spkData/datasets/recVidarReal2019/config.yaml"
    (stream.parents[1] / "config.yaml").write_bytes(description.read_bytes())
    pack(np.random.default_rng(1).random((20, 250, 400)) < 0.3).tofile(stream)


def spikecv(root: Path) -> Values:
    """Return the spikes of a camera, and those of SpikeCV's own layout as `import-spikecv` reads them."""
    imported = root / "imported"
    datasets = root / "spikecv/spkData/datasets"
    stream = import_spikecv(datasets / "recVidarReal2019", imported, Recording(20000.0))["ballon"]
    ours = open_scene(root / "scene").stream("cam_01")
    return {"export": listed(ours.window(0, ours.n_ticks)), "import": listed(stream.window(0, stream.n_ticks))}


def spikezoo(root: Path) -> Values:
    """Return a camera's spikes, and the mean of the 41 around the middle of the clip."""
    stream = open_scene(root / "scene").stream("cam_01")
    middle = stream.n_ticks // 2
    mean = stream.counts(middle - 20, middle + 21) / 41
    return {"spikes": listed(stream.window(0, stream.n_ticks)), "tfp": listed(mean)}


def d_nerf(root: Path) -> Values:
    """Return the times of all images by name, and the origins and directions of the rays through some pixels."""
    scene, pixels = open_scene(root / "scene"), np.load(root / "pixels.npy")
    images = [target for part in ("train", "test") for _, target in exported(root, part)]
    rays = []
    for target in images:
        camera = scene.cameras[target.camera]
        toward = camera.unproject(pixels, np.ones(len(pixels))) - camera.center
        unit = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        rays.append(np.concatenate([np.broadcast_to(camera.center, unit.shape), unit], axis=1))
    times = [target.tick / scene.n_ticks for target in images]
    return {"times": times, "rays": listed(rays), "rays, per-image intrinsics": listed(rays)}


def nerfbaselines(root: Path) -> Values:
    """Return where points are seen in the training images, and the images' means."""
    scene, points = open_scene(root / "scene"), np.load(root / "points.npy")
    targets = [target for _, target in exported(root, "train")]
    seen = [scene.cameras[t.camera].project(points)[0] for t in targets]
    return {"points": listed(seen), "images": [from_spikes(scene, t).mean() for t in targets]}


def colmap(root: Path) -> Values:
    """Return where points are seen in the images of the model."""
    scene, points = open_scene(root / "scene"), np.load(root / "points.npy")
    names = sorted(path.parent.name for path in (root / "colmap/images").glob("*/*.png"))
    return {"points": listed([scene.cameras[name].project(points)[0] for name in names])}


def splats(root: Path) -> Values:
    """Return the Gaussians that are visible at the times of the files: as a viewer shows them, frame by frame."""
    saved = load_model(root / "model.safetensors", "cpu")
    found: dict[str, list[Any]] = {"positions": [], "scales": [], "opacities": [], "grays": [], "rotations": []}
    for path in sorted((root / "ply").glob("*.ply")):
        at = saved.model.splats(int(path.stem) * 1e6 / saved.provenance.rate_hz)  # type: ignore[union-attr]
        seen = at.opacities >= ALPHA_MIN
        quats = at.quats[seen] / at.quats[seen].norm(dim=1, keepdim=True)
        found["positions"].append(at.means[seen].detach().numpy())
        found["scales"].append(at.scales[seen].detach().numpy())
        found["opacities"].append(at.opacities[seen].detach().numpy())
        found["grays"].append(srgb(at.colors[seen, 0].detach().double().numpy()))
        found["rotations"].append((quats * quats[:, :1].sign()).detach().numpy())
    return {name: listed(np.concatenate(frames)) for name, frames in found.items()}


def container(root: Path) -> Values:
    """Return the same Gaussians for a container that rounds them, before and after."""
    found = splats(root)
    written = {f"{name}, written and read": found[name] for name in ("positions", "opacities")}
    return {**found, **written}


def metrics(root: Path) -> Values:
    """Return PSNR of the pairs, and SSIM, which has no border: half a window is left out there."""
    with np.load(root / "images.npz") as images:
        pairs = [
            ImagePair(truth, prediction, np.ones(truth.shape, bool), "pair")
            for truth, prediction in zip(images["truth"], images["prediction"], strict=True)
        ]
    names = {"psnr": "psnr", "ssim, inside": "ssim"}
    return {name: [float(METRICS[id].measure(pair) or 0) for pair in pairs] for name, id in names.items()}


def croissant(root: Path) -> Values:
    """Return the ticks of the scored images, and of the ground truth with its times."""
    scene = open_scene(root / "scene")
    ticks = [float(target.tick) for target in scene.targets]
    return {"targets": ticks, "images": ticks, "times": [tick * 1e6 / scene.rate_hz for tick in ticks], "errors": [0.0]}


def exported(root: Path, part: str) -> Iterator[tuple[Path, Target]]:
    """Yield the images of a part of `export-nerfstudio` by name."""
    for path in sorted((root / "nerfstudio" / part).glob("*.png")):
        camera, _, tick = path.stem.rpartition("_")
        yield path, Target(camera, int(tick))


def from_spikes(scene: Scene, target: Target) -> Any:
    """Return a training image as 8-bit display values [H, W]."""
    return encode_srgb(IMAGES["tfp"](scene.stream(target.camera), [target.tick], scene.radiance_gain)[0])


def listed(values: Any) -> list[float]:
    """Return numbers of any shape as a list."""
    return [float(value) for value in np.asarray(values, dtype=np.float64).ravel()]
