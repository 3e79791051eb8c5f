"""`render`: a video of a fitted model in slow motion, along a path of cameras."""

from __future__ import annotations

from pathlib import Path

from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.environment import choose_device
from spike4dgs.method.models.saved_model import load_model
from spike4dgs.method.viewing.camera_paths import PathName, make_path
from spike4dgs.method.viewing.render_video import PLAYBACK, Playback, render_video


def render(
    model: Positional[Path],
    *,
    path: PathName = "orbit",
    camera: str | None = None,
    playback: OmitArgPrefixes[Playback] = PLAYBACK,
    out: Path | None = None,
    frames: Path | None = None,
    device: str = "cpu",
) -> int:
    """Render a fitted model along a path of cameras, in slow motion, to a video or a folder of images.

    Args:
        model: A model saved by run-benchmark, OUT/models/METHOD/SCENE.safetensors, or by fit, OUT/model.safetensors.
        path: orbit: an ellipse as large as the camera array, around its middle; rig: from training camera to training
            camera; still: one training camera.
        camera: The training camera of `still`; the middle one if left out.
        out: Video, .mp4 (VP9) or .avi (Motion JPEG); SCENE-PATH.mp4 if left out, or none if --frames is given.
        frames: New folder for the frames as PNG.
        device: auto, cpu or cuda.
    """
    playback.check()
    saved = load_model(model, choose_device(device))
    if out is None and frames is None:
        out = Path(f"{saved.provenance.scene}-{path}.mp4")
    replaced = out is not None and out.is_file()
    count, size = render_video(saved, make_path(path, saved.provenance.cameras, camera), playback, out, frames)
    seconds = count / playback.fps
    for target in filter(None, (out, frames)):
        what = f"{count} frames of {size[0]}x{size[1]}, {seconds:.1f} s at {playback.fps:g} frames/s"
        print(f"{target}: {what}" + ("; an earlier video was replaced" if replaced and target == out else ""))
    return 0
