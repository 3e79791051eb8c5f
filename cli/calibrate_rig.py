"""`calibrate-rig`: intrinsics and poses of an array from clips of a moving chessboard, with a report and an image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from tyro.conf import OmitArgPrefixes, Positional

from spike4dgs.benchmark.errors import problem
from spike4dgs.benchmark.files import check_writable, locked, remove_parts, write_json, write_text
from spike4dgs.benchmark.reports.figure import new_figure, save_figure
from spike4dgs.generators.recorder.rig_calibration.array_calibration import (
    ArrayCalibration,
    calibrate_array,
    differences,
)
from spike4dgs.generators.recorder.rig_calibration.board import Board
from spike4dgs.generators.recorder.rig_calibration.board_views import (
    BoardRecording,
    BoardViews,
    choose_views,
    common_cameras,
    find_all,
    make_image,
    open_recording,
)
from spike4dgs.generators.recorder.rig_calibration.bundle_adjustment import Freedom
from spike4dgs.generators.recorder.rig_profile import calibration_toml
from spike4dgs.studies.kit.timing import show_table

_BOARD, _FREEDOM = Board(), Freedom()


def calibrate_rig(
    clips: Positional[tuple[Path, ...]],
    *,
    out: Path = Path("runs/rig"),
    board: OmitArgPrefixes[Board] = _BOARD,
    views: int = 40,
    window_ticks: int = 100,
    freedom: OmitArgPrefixes[Freedom] = _FREEDOM,
    allow_gaps: bool = False,
) -> int:
    """Calibrate an array from clips of a moving chessboard: OUT/calibration.toml, report.json and corners.png.

    Args:
        clips: Recordings of the board (scene folders), all by the same cameras.
        out: Folder for the results.
        board: The board.
        views: Number of views (windows of ticks), in all clips together.
        window_ticks: Ticks that are summed into an image; more give less noise and more motion blur.
        freedom: What is estimated.
        allow_gaps: Use clips with gaps; images with missing ticks are left out.
    """
    if not clips:
        raise problem("calibrate-rig", "one or more clips", "none", "record the board with `spike4dgs record`")
    if views < 1:
        raise problem("--views", "1 or more", str(views), "correct it")
    check_writable(out)
    recordings = [open_recording(path, allow_gaps) for path in clips]
    names, size = common_cameras(recordings)
    chosen = choose_views(recordings, views, window_ticks)
    seen = find_all(recordings, names, chosen, board)
    found = calibrate_array(seen.detections, board, names, size, freedom)
    report = {
        "clips": [r.name for r in recordings],
        "board": asdict(board),
        "views": {"looked_at": len(chosen), "with_board": len(seen.views), "window_ticks": window_ticks},
        **_results(found),
        "against_clip": differences(found.cameras, recordings[0].cameras),
    }
    with locked(out / ".lock", out, "a folder that no other calibration writes to", temporary=True):
        remove_parts(out)
        write_text(out / "calibration.toml", calibration_toml(found.cameras))
        write_json(out / "report.json", report)
        _plot(recordings, seen, found, out / "corners.png")
    _print(report)
    print("an array of mirrored images calibrates as well: text in front of a camera must be readable in `inspect`")
    print(f"calibration, report and image: {out}")
    return 0


def _results(found: ArrayCalibration) -> dict[str, Any]:
    a, s = found.adjusted, found.detections
    cameras = {
        camera.id: {
            "views": int(np.sum(s.camera == c)),
            "reprojection_px": found.per_camera_px[c],
            "focal_px": camera.fx,
            "focal_sd_px": float(a.focal_px[c]),
            "principal_point_px": [camera.cx, camera.cy],
            **({"distortion": list(camera.distortion)} if camera.distortion else {}),
            "center_sd_m": float(a.center_m[c]),
            "turn_sd_deg": float(a.turn_deg[c]),
        }
        for c, camera in enumerate(found.cameras)
    }
    used, left_out = found.corners
    return {
        "reprojection_px": found.reprojection_px,
        "corners": {"used": used, "left_out": left_out},
        "reference": found.cameras[found.reference].id,
        "cameras": cameras,
    }


def _print(report: dict[str, Any]) -> None:
    rows = []
    for name, c in report["cameras"].items():
        x, y = c["principal_point_px"]
        row = [name, f"{c['views']}", f"{c['reprojection_px']:.3f}", f"{c['focal_px']:.2f}", f"{c['focal_sd_px']:.2f}"]
        rows.append([*row, f"{x:.1f}, {y:.1f}", f"{1e3 * c['center_sd_m']:.2f}", f"{c['turn_sd_deg']:.3f}"])
    columns = "camera", "views", "RMS, px", "focal, px", "+-", "principal, px", "position +-, mm", "turn +-, deg"
    show_table(f"reprojection error {report['reprojection_px']:.3f} px RMS", columns, rows, None)
    for name, c in report["cameras"].items():
        if lens := c.get("distortion"):
            print(f"{name}: k1 {lens[0]:.4f}, k2 {lens[1]:.4f}")
    views, corners = report["views"], report["corners"]
    print(
        f"{views['with_board']} of {views['looked_at']} views have the board; "
        f"{corners['left_out']} of {sum(corners.values())} corners do not fit and are left out"
    )
    print(f"standard deviations of position and turn are relative to {report['reference']}")
    if d := report["against_clip"]:
        position = f"{1e3 * d['translation_m']:.2f} and {1e3 * d['translation_max_m']:.2f} mm"
        print("against the cameras that the clip states, mean and worst error:")
        print(f"  rotation {d['rotation_deg']:.3f} and {d['rotation_max_deg']:.3f} deg, position {position}")
        print(f"  scale {100 * d['scale']:.3f} %, focal length at worst {100 * d['focal_max']:.3f} %,")
        print(f"  principal point at worst {d['principal_point_max_px']:.2f} px")


def _plot(recordings: Sequence[BoardRecording], seen: BoardViews, found: ArrayCalibration, path: Path) -> None:
    """Plot each camera's image in the view that most cameras saw, with its corners; small, the corners of all views."""
    s = found.detections
    best = int(np.argmax(np.bincount(s.view)))
    side = math.ceil(math.sqrt(len(found.cameras)))
    aspect = found.cameras[0].height / found.cameras[0].width
    figure = new_figure((12, 12 * aspect * math.ceil(len(found.cameras) / side) / side + 1), dpi=100)
    for axes, c in zip(figure.subplots(side, side, squeeze=False).flat, range(side * side), strict=True):
        axes.axis("off")
        if c >= len(found.cameras):
            continue
        name = found.cameras[c].id
        image = make_image(recordings[seen.views[best].recording], name, seen.views[best])
        if image is not None:
            axes.imshow(image, cmap="gray", extent=(0, image.shape[1], image.shape[0], 0))
        mine = s.of(s.camera == c)
        axes.scatter(*mine.uv[mine.used].T, s=1, color="tab:orange", linewidths=0)
        axes.scatter(*mine.uv[~mine.used].T, s=12, color="tab:red", marker="x", linewidths=0.8)
        for uv in mine.uv[mine.view == best]:
            axes.plot(*uv.T, color="tab:cyan", linewidth=0.6, marker=".", markersize=4)
        axes.set_title(f"{name}: {len(mine.view)} views, {found.per_camera_px[c]:.3f} px", fontsize=9)
    figure.suptitle(
        f"Used corners (orange), left out (red), and the board in one view; {found.reprojection_px:.3f} px RMS"
    )
    save_figure(figure, path)
