"""Every reader on hostile files, in a process of its own: `python tests/support/hostile_files.py --inputs 10000`.

A reader may accept a file or raise UserError with one line. Anything else is a failure: another exception, a crash, a
minute of computing, a GB of memory, or a file outside the folder that it was given.
"""

import argparse
import contextlib
import hashlib
import io
import json
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import mutations as m
import numpy as np
from rig_text import POSED

MOST_SECONDS, MOST_MB = 60, 1000  # of processor time for one input; of memory at the peak
Read = Callable[[Path, Path], Any]  # folder of the files, folder for what is made of them


@dataclass(frozen=True)
class Case:
    """A kind of input: valid files, what may be changed in them, and who reads them."""

    share: int  # of every hundred inputs; the readers of most formats get most
    make: Callable[[Path], Any]
    read: Read
    files: dict[str, m.Mutation | None]  # glob -> a mutation that knows the format
    repair: Callable[[Path], None] | None = None  # makes hashes agree again


@dataclass
class Outcome:
    """What came of the inputs of one case."""

    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    worst_s: float = 0.0
    failures: list[str] = field(default_factory=list)


def read_all(reads: Iterable[Callable[[], Any]]) -> None:
    """Call every reader; then raise the error of the last one that refused its file."""
    from spike4dgs.benchmark.errors import UserError

    refused = None
    for read in reads:
        try:
            read()
        except UserError as e:
            refused = e
    if refused:
        raise refused


# ---------------------------------------------------------------- scenes and predictions


def make_scene(folder: Path) -> None:
    from full_scene import write_full_scene

    write_full_scene(folder / "scene")


def rehash(folder: Path) -> None:
    """Make the manifest agree with the files, as a program that writes foreign scenes would."""
    path = folder / "scene/manifest.json"
    with contextlib.suppress(Exception):
        data = json.loads(path.read_text())
        for name, entry in data["files"].items():
            content = (folder / "scene" / name).read_bytes()
            entry.update(bytes=len(content), sha256=hashlib.sha256(content).hexdigest())
        path.write_text(json.dumps(data))


def read_scene(folder: Path, out: Path) -> None:
    from spike4dgs.benchmark.scene.images import read_geometry
    from spike4dgs.benchmark.scene.scene import open_scene

    scene = open_scene(folder / "scene", allow_gaps=True)
    for name in scene.meta["splits"]:
        open_scene(folder / "scene", allow_gaps=True, split=name)
    for target in scene.targets:
        scene.ground_truth(target), scene.moving(target)
    for camera in scene.train:
        scene.stream(camera).counts(0, min(scene.n_ticks, 60))
    training = scene.training
    _ = training.calibrations, training.duration_us
    for camera in training.found_frames:
        _ = [frame.radiance for frame in training.frames(camera)]
    for camera in training.found_events:
        len(training.events(camera))
    read_geometry(scene.manifest.path("geometry/cam_03/000020.exr"))


def make_predictions(folder: Path) -> None:
    from spike4dgs.benchmark.runs.predictions import MethodInfo, PredictionInfo, PredictionWriter
    from spike4dgs.benchmark.scene.scene import open_scene

    make_scene(folder)
    scene = open_scene(folder / "scene")
    with PredictionWriter(folder / "predictions") as writer:
        for target in scene.targets:
            writer.add(target, scene.ground_truth(target) * np.float32(0.9), 1.0)
        method = MethodInfo("mine", "1", {"a": {"b": 1.5}}, 0)
        writer.finish(PredictionInfo(method, scene.id, scene.revision, fit_seconds=1.5))


def resum(folder: Path) -> None:
    root = folder / "predictions"
    sums = {p: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(root.rglob("*.exr"))}
    (root / "SHA256SUMS").write_text("".join(f"{digest}  {p.relative_to(root)}\n" for p, digest in sums.items()))


def read_predictions(folder: Path, out: Path) -> None:
    from spike4dgs.benchmark.metrics.measure import select_metrics
    from spike4dgs.benchmark.runs.score import score_predictions
    from spike4dgs.benchmark.scene.scene import open_scene

    chosen = select_metrics().among(["psnr", "psnr_aligned"])
    score_predictions(folder / "predictions", [open_scene(folder / "scene")], chosen)


# ---------------------------------------------------------------- records and the leaderboard


def make_record(folder: Path) -> None:
    from spike4dgs.benchmark.metrics.measure import select_metrics
    from spike4dgs.benchmark.runs.record import write_record
    from spike4dgs.benchmark.runs.score import score_predictions
    from spike4dgs.benchmark.scene.scene import open_scene

    make_predictions(folder)
    chosen = select_metrics().among(["psnr", "psnr_aligned", "ssim"])
    record = score_predictions(folder / "predictions", [open_scene(folder / "scene")], chosen)
    write_record(folder / "mine.json", record)
    shutil.rmtree(folder / "scene"), shutil.rmtree(folder / "predictions")


def make_board(folder: Path) -> None:
    from submissions import submit

    make_record(folder)
    submit(folder / "mine.json", leaderboard=folder / "board")
    (folder / "mine.json").unlink()


def read_record_file(folder: Path, out: Path) -> None:
    from submissions import submit

    from spike4dgs.benchmark.runs.record import read_record
    from spike4dgs.benchmark.runs.results import records_to_dataframe

    record = read_record(folder / "mine.json")
    with contextlib.suppress(ImportError):
        import pandas  # noqa: F401

        records_to_dataframe(record), records_to_dataframe(record, per_image=True)
    submit(folder / "mine.json", leaderboard=out / "board", replace=True)


def read_board(folder: Path, out: Path) -> None:
    from spike4dgs.leaderboard.rank import write_boards

    write_boards(folder / "board")


def relist(folder: Path) -> None:
    """Give the ledger a line for each entry, as somebody who also knows the ledger would."""
    from spike4dgs.benchmark.files import sha256_json
    from spike4dgs.leaderboard.ledger import add_line

    board = folder / "board"
    for path in board.glob("*/*/*.json"):
        with contextlib.suppress(Exception):
            add_line(board, sha256_json(json.loads(path.read_text())), f"{path.relative_to(board)}")


# ---------------------------------------------------------------- models, weights, bursts


def make_models(folder: Path) -> None:
    from saved_models import model, provenance

    for name in ("static", "hexplane", "spacetime", "paths", "tracking", "radiance-field"):
        model(name).save(folder / f"{name}.safetensors", provenance())


def rehash_model(folder: Path) -> None:
    """Make the models' own hashes agree."""
    import safetensors.torch

    from spike4dgs.method.models.model_file import _digest

    for path in folder.glob("*.safetensors"):
        with contextlib.suppress(Exception):
            with safetensors.safe_open(path, framework="pt") as f:
                meta, tensors = f.metadata(), {name: f.get_tensor(name) for name in f.keys()}
            meta["sha256"] = _digest(meta["about"], tensors)
            safetensors.torch.save_file(tensors, path, metadata=meta)


def in_model(data: bytes, rng: m.Rng) -> bytes:
    """The text about the model states something else."""
    size = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + size])
    header["__metadata__"]["about"] = m.emit(m.change(json.loads(header["__metadata__"]["about"]), rng))
    text = json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data[8 + size :]


_ACCEPTED = set[bytes]()  # digests of models that were read and rendered: most inputs have but one that is damaged


def read_models(folder: Path, out: Path) -> None:
    from saved_models import WORLD

    from spike4dgs.method.models.saved_model import load_model

    def read(path: Path) -> None:
        if (digest := hashlib.sha256(path.read_bytes()).digest()) in _ACCEPTED:
            return
        saved = load_model(path)
        if saved.provenance.duration_us < 1e12:
            saved.model.render(WORLD.cameras[0], 0.3 * saved.provenance.duration_us)
        _ACCEPTED.add(digest)

    read_all(partial(read, path) for path in sorted(folder.glob("*.safetensors")))


def make_tensors(folder: Path) -> None:
    import torch
    from toy_bursts import write_toy_shard

    from spike4dgs.baselines.images.spk2img.maker import WEIGHTS
    from spike4dgs.method.checkpoint import Checkpoint, save_checkpoint

    write_toy_shard(folder, 13)
    save_checkpoint(folder / "fit.ckpt", Checkpoint(3, {"a.x": torch.arange(6.0)}), "fit")
    torch.save({"x": torch.arange(6.0)}, folder / "state.pth")
    shutil.copyfile(WEIGHTS.shipped, folder / "weights.safetensors")


def read_tensors(folder: Path, out: Path) -> None:
    from spike4dgs.baselines.images.spk2img.maker import WEIGHTS
    from spike4dgs.benchmark.scene.training_bursts import open_bursts
    from spike4dgs.benchmark.weights import read_state
    from spike4dgs.method.checkpoint import load_checkpoint

    def bursts() -> None:
        file = open_bursts(folder / "toy-13.safetensors")
        for number in range(min(len(file), 3)):
            file.read(number)

    weights = folder / "weights.safetensors"
    states = (partial(read_state, path) for path in (weights, folder / "state.pth"))
    read_all([bursts, lambda: load_checkpoint(folder / "fit.ckpt", "fit"), lambda: WEIGHTS.read_card(weights), *states])


# ---------------------------------------------------------------- recordings and other programs' files


def make_imports(folder: Path) -> None:
    import cv2
    import pycolmap
    import yaml
    from small_scenes import HEIGHT, WIDTH, array_cameras

    from spike4dgs.benchmark.spikes.stream import pack

    rng, cameras = np.random.default_rng(2), array_cameras(2)
    (folder / "in").mkdir()
    for c in cameras:
        pack(rng.random((16, HEIGHT, WIDTH)) < 0.3).tofile(folder / f"in/{c.id}.dat")
    model = pycolmap.Reconstruction()
    for i, c in enumerate(cameras, start=1):
        params = [c.fx, c.fy, c.cx, c.cy, 0.01, 0, 0, 0]
        camera = pycolmap.Camera(camera_id=i, model="OPENCV", width=WIDTH, height=HEIGHT, params=params)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(image_id=i, camera_id=i, name=f"{c.id}.png")
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(c.R), c.t))
    model.add_point3D(np.zeros(3), pycolmap.Track(), np.full(3, 128, dtype=np.uint8))
    for kind in ("colmap", "colmap-text"):
        (folder / kind).mkdir()
    model.write_binary(str(folder / "colmap"))
    model.write_text(str(folder / "colmap-text"))
    for suffix in ("yml", "xml"):
        file = cv2.FileStorage(str(folder / f"opencv.{suffix}"), cv2.FILE_STORAGE_WRITE)
        for c in cameras:
            file.startWriteStruct(c.id, cv2.FILE_NODE_MAP)
            for key, value in {"camera_matrix": c.K, "R": c.R, "T": c.t.reshape(3, 1), "image_width": WIDTH}.items():
                file.write(key, value)
            file.endWriteStruct()
        file.release()
    chain: dict[str, Any] = {c.id: {"camera_model": "pinhole", "distortion_model": "radtan"} for c in cameras}
    for c in cameras:
        chain[c.id] |= {"intrinsics": [c.fx, c.fy, c.cx, c.cy], "resolution": [WIDTH, HEIGHT]}
        chain[c.id]["distortion_coeffs"] = [0.01, 0.0, 0.0, 0.0]
    chain[cameras[1].id]["T_cn_cnm1"] = (cameras[1].w2c @ cameras[0].c2w).tolist()
    (folder / "kalibr.yaml").write_text(yaml.safe_dump(chain))
    (folder / "spikecv").mkdir()
    rng.integers(0, 256, 16 * HEIGHT * WIDTH // 8, dtype=np.uint8).tofile(folder / "spikecv/a.dat")
    config = {"filename": "a.dat", "spike_w": WIDTH, "spike_h": HEIGHT}
    (folder / "spikecv/config.yaml").write_text(yaml.safe_dump(config))


def read_imports(folder: Path, out: Path) -> None:
    from small_scenes import HEIGHT, WIDTH

    from spike4dgs.benchmark.exchange.dat import import_dat
    from spike4dgs.benchmark.exchange.recording import Recording
    from spike4dgs.benchmark.exchange.spikecv import import_spikecv

    facts = {"width": WIDTH, "height": HEIGHT, "recording": Recording(20000.0)}
    reads = [
        partial(import_dat, folder / "in", **facts, out=out / name, cameras=folder / name)
        for name in ("colmap", "colmap-text", "opencv.yml", "opencv.xml", "kalibr.yaml")
    ]
    read_all([*reads, lambda: import_spikecv(folder / "spikecv", out / "spikecv", Recording(20000.0))])


def make_footage(folder: Path) -> None:
    import cv2
    from PIL import Image

    rng = np.random.default_rng(3)
    frames = rng.integers(0, 256, (3, 24, 40, 3), dtype=np.uint8)
    for name in ("png", "jpg", "bmp", "tif"):
        (folder / "images" / name).mkdir(parents=True)
        for k, frame in enumerate(frames):
            Image.fromarray(frame).save(folder / f"images/{name}/{k}.{name}")
    (folder / "videos").mkdir()
    video = cv2.VideoWriter(str(folder / "videos/a.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 30, (40, 24))
    for frame in frames:
        video.write(frame)
    video.release()
    rows = [f"cam_{c},0,{p},{p + c},7.5" for c in range(2) for p in range(20)]
    (folder / "points.csv").write_text("\n".join(["camera,frame,point,x,y", *rows]) + "\n")


def read_footage(folder: Path, out: Path) -> None:
    from spike4dgs.benchmark.exchange.marked_points import read_marked_points
    from spike4dgs.generators.held_frames.footage import find_footage, read_frames

    def frames(name: str) -> None:
        for footage in find_footage(folder / name).values():
            list(read_frames(footage, range(footage.frames)))

    read_all([partial(frames, "images"), partial(frames, "videos"), lambda: read_marked_points(folder / "points.csv")])


def make_recording(folder: Path) -> None:
    from spike4dgs.benchmark.spikes.folder import write_stream_folder
    from spike4dgs.benchmark.spikes.gaps import Gap
    from spike4dgs.benchmark.spikes.stream import open_stream, pack

    rig, more = POSED, {"3.5]": "distortion = [0.01, 0.0]"}
    for line, after in (more | {'"plain"': 'fps = 20000\nheld_out = ["left"]'}).items():
        rig = rig.replace(line, f"{line}\n{after}")
    (folder / "rig.toml").write_text(rig)
    streams = {}
    for name in ("left", "right"):
        pack(np.zeros((16, 24, 40), bool)).tofile(folder / f"{name}.dat")
        streams[name] = open_stream(folder / f"{name}.dat", 40, 24, 2e4, gaps=(Gap(name, 3, 2, "usb"),))
    write_stream_folder(folder, streams, {"source": {"kind": "test"}})


def read_recording(folder: Path, out: Path) -> None:
    from spike4dgs.benchmark.spikes.folder import open_stream_folder
    from spike4dgs.generators.recorder.rig_profile import load_profile

    read_all([lambda: load_profile(folder / "rig.toml"), lambda: open_stream_folder(folder, allow_gaps=True)])


_JSON_OF_SCENE = ("scene/scene.json", "scene/transforms_t*.json", "scene/targets.json", "scene/manifest.json")
_OF_SCENE: dict[str, m.Mutation | None] = {
    **dict.fromkeys(_JSON_OF_SCENE, m.in_json),
    **dict.fromkeys(("scene/spikes/*.dat", "scene/calibration/*/*.dat"), None),
    **dict.fromkeys(("scene/images/*/*.exr", "scene/geometry/*/*.exr"), m.in_exr),
    **dict.fromkeys(("scene/masks/*/*.png", "scene/conventional/*/*.png"), m.in_png),
    "scene/events/*.npz": m.in_npz,
}
_OF_PREDICTIONS = {"prediction.json": m.in_json, "SHA256SUMS": m.in_text, "*/*.exr": m.in_exr}
_OF_TENSORS = {"*.safetensors": m.in_safetensors, "fit.ckpt": m.in_safetensors, "state.pth": None}
_OF_IMPORTS: dict[str, m.Mutation | None] = {
    **dict.fromkeys(("colmap-text/*.txt", "opencv.*", "kalibr.yaml", "spikecv/config.yaml"), m.in_text),
    **dict.fromkeys(("colmap/*.bin", "in/*.dat", "spikecv/a.dat"), None),
}
_OF_FOOTAGE = {"images/png/*": m.in_png, "images/[jbt]*/*": None, "videos/*": None, "points.csv": m.in_text}
_OF_RECORDING = {"rig.toml": m.in_text, "stream.json": m.in_json, "left.npz": m.in_npz}
CASES: dict[str, Case] = {
    "scene": Case(35, make_scene, read_scene, _OF_SCENE, rehash),
    "predictions": Case(
        10, make_predictions, read_predictions, {f"predictions/{k}": v for k, v in _OF_PREDICTIONS.items()}, resum
    ),
    "record": Case(13, make_record, read_record_file, {"mine.json": m.in_json}),
    "board": Case(6, make_board, read_board, {"board/local/*/*.json": m.in_json, "board/LEDGER": m.in_text}, relist),
    "models": Case(8, make_models, read_models, {"*.safetensors": in_model}, rehash_model),
    "tensors": Case(8, make_tensors, read_tensors, _OF_TENSORS),
    "imports": Case(10, make_imports, read_imports, _OF_IMPORTS),
    "footage": Case(5, make_footage, read_footage, _OF_FOOTAGE),
    "recording": Case(5, make_recording, read_recording, _OF_RECORDING),
}

# ---------------------------------------------------------------- running


def damage(folder: Path, case: Case, rng: m.Rng) -> list[str]:
    """Change one to three files of a folder; return what was done."""
    done = []
    for _ in range(int(rng.choice([1, 1, 1, 2, 3]))):
        files = sorted(folder.glob(m.pick(rng, list(case.files))))
        if not files:
            continue
        path = m.pick(rng, files)
        known = next(f for glob, f in case.files.items() if path in folder.glob(glob))
        how = rng.random()
        if how < 0.04:
            other = m.pick(rng, [p for p in sorted(folder.rglob("*")) if p.is_file()])
            shutil.copyfile(other, path) if other != path else path.unlink()
            done.append(f"{path.name} is {other.name}")
            continue
        mutation = known if known is not None and how < 0.65 else m.pick(rng, m.BYTES)
        with contextlib.suppress(Exception):  # the format is not known any more after a first change
            path.write_bytes(mutation(path.read_bytes(), rng))
            done.append(f"{path.name}: {mutation.__name__}")
    if case.repair and rng.random() < 0.8:
        case.repair(folder)
    return done


def listing(root: Path) -> dict[str, int]:
    """Everything in a folder that no reader has to do with, with its time of change."""
    found, folders = {}, [str(root)]
    while folders:
        for entry in os.scandir(folders.pop()):
            if entry.path != str(root / "work"):
                found[entry.path] = entry.stat().st_mtime_ns
                folders += [entry.path] if entry.is_dir(follow_symlinks=False) else []
    return found


def run(root: Path, inputs: int, seed: int, only: str = "") -> dict[str, Outcome]:
    """Give the readers `inputs` hostile inputs in `root`; return what came of them, by case."""
    from spike4dgs.benchmark.compilation import _folder
    from spike4dgs.benchmark.errors import UserError

    home, work = root / "home", root / "work"
    for folder in (home, root / "cwd", work):
        folder.mkdir(parents=True)
    os.environ.setdefault("NUMBA_CACHE_DIR", _folder())  # the user's: kernels take long to compile
    os.environ.update(HOME=str(home), XDG_CACHE_HOME=str(home / "cache"), TMPDIR=str(work))
    (root / "untouched").write_text("untouched")
    os.chdir(root / "cwd")
    names = [name for name, case in CASES.items() for _ in range(case.share) if only in ("", name)]
    order = np.random.default_rng(seed).choice(names, inputs)
    for name in dict.fromkeys(order):
        (root / "valid" / name).mkdir(parents=True)
        with contextlib.redirect_stdout(io.StringIO()):
            CASES[name].make(root / "valid" / name)
            shutil.copytree(root / "valid" / name, work / "trial"), (work / "out").mkdir()
            CASES[name].read(work / "trial", work / "out")  # valid files are accepted, and lazy imports done
        shutil.rmtree(work / "trial"), shutil.rmtree(work / "out")
    before, outcomes = listing(root), {str(name): Outcome() for name in dict.fromkeys(order)}
    signal.signal(signal.SIGPROF, _too_long)
    for i, name in enumerate(map(str, order)):
        (root / "work/now").write_text(f"{name} {seed} {i}")
        outcome, rng = outcomes[name], np.random.default_rng([seed, i])
        trial, out = work / "trial", work / "out"
        shutil.copytree(root / "valid" / name, trial, copy_function=shutil.copyfile), out.mkdir()
        outcome.inputs += 1
        done = damage(trial, CASES[name], rng)
        begun = time.process_time()
        signal.setitimer(signal.ITIMER_PROF, MOST_SECONDS)
        text = io.StringIO()
        try:
            with contextlib.redirect_stdout(text), contextlib.redirect_stderr(text):
                CASES[name].read(trial, out)
            outcome.accepted += 1
        except UserError as e:
            outcome.refused += 1
            if len(str(e).splitlines()) != 1 or len(str(e)) > 3000 or not _printable(str(e)):
                outcome.failures.append(f"{name} {i} {done}: no line of an error: {str(e)[:300]!r}")
        except BaseException as e:
            if isinstance(e, KeyboardInterrupt):
                raise
            outcome.failures.append(f"{name} {i} {done}: {traceback.format_exc(limit=-4)}")
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        outcome.worst_s = max(outcome.worst_s, time.process_time() - begun)
        if (after := listing(root)) != before:
            outcome.failures.append(
                f"{name} {i} {done}: written outside: {sorted(set(after.items()) ^ set(before.items()))[:5]}"
            )
            before = after
        shutil.rmtree(trial), shutil.rmtree(out)
    return outcomes


def _printable(text: str) -> bool:
    try:
        return bool(text.encode())
    except UnicodeError:
        return False


def _too_long(*_: object) -> None:
    raise TimeoutError(f"more than {MOST_SECONDS} s")


def peak_memory_mb() -> float:
    """Return this process's largest resident memory. What the system reports of usage also counts the parent's."""
    status = Path("/proc/self/status")
    if status.is_file():
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM")) / 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def main() -> int:
    p = argparse.ArgumentParser(description=__doc__)
    p.add_argument("--inputs", type=int, default=300)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--only", default="", choices=("", *CASES))
    a = p.parse_args()
    warnings.simplefilter("ignore")
    begun = time.time()
    memory = Path("/dev/shm")  # a disk takes long for many small files
    with tempfile.TemporaryDirectory(dir=memory if os.access(memory, os.W_OK) else None) as folder:
        outcomes = run(Path(folder).resolve(), a.inputs, a.seed, a.only)
        os.chdir("/")
    peak_mb = peak_memory_mb()
    for name, o in outcomes.items():
        print(f"{name}: {o.inputs} inputs, {o.accepted} accepted, {o.refused} refused, worst {o.worst_s:.1f} s")
    failures = [f for o in outcomes.values() for f in o.failures]
    print(f"{a.inputs} inputs in {time.time() - begun:.0f} s, {peak_mb:.0f} MB at the peak, {len(failures)} failures")
    for failure in failures[:40]:
        print(failure)
    return 1 if failures or peak_mb > MOST_MB else 0


if __name__ == "__main__":
    sys.exit(main())
