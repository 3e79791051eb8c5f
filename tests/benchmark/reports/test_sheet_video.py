"""The video shows what the sheet does: decoded frames are the same panels."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from sheets import write_results

from spike4dgs.benchmark.reports.panels import make_panels
from spike4dgs.benchmark.reports.sheet_video import FPS, WIDEST, Layout, make_layout, write_sheet_video


def frames(path: Path) -> list[np.ndarray]:
    video, found = cv2.VideoCapture(str(path)), []
    while (read := video.read())[0]:
        found.append(read[1][:, :, ::-1].astype(int))
    assert video.get(cv2.CAP_PROP_FPS) == FPS
    return found


def test_frames_decode_and_are_the_sheets_panels(tmp_path: Path) -> None:
    results = write_results(tmp_path, {"worse": 0.15, "fine": 0.003}, {"bad": "no luck"})
    write_sheet_video(tmp_path / "v.mp4", results.scene, results.folders, results.records)
    panels = make_panels(results.scene, results.folders, results.records)
    layout, found = make_layout(panels), frames(tmp_path / "v.mp4")
    assert len(found) == 3 and found[0].shape[1::-1] == layout.size and layout.cells == 3, "without the failed one"
    names = [None, "worse", "fine"]
    for k, frame in enumerate(found):
        for cell, name in enumerate(names):
            wanted = {n: panels.image(n, k).repeat(layout.zoom, 0).repeat(layout.zoom, 1) for n in names}
            difference = {n: np.abs(frame[layout.image(cell)] - w[..., None]).mean() for n, w in wanted.items()}
            # Video is lossy; the fine method differs from the truth by less than that.
            assert difference[name] < 4
            assert min(difference["worse" if name != "worse" else n] for n in names if n != name) > 6
            if name is not None:
                errors = panels.errors(name, k).repeat(layout.zoom, 0).repeat(layout.zoom, 1)
                shown = frame[layout.errors(cell)]
                assert np.corrcoef(shown.ravel(), errors.ravel())[0, 1] > 0.9  # colours have half the resolution
                other = panels.errors("worse" if name == "fine" else "fine", k).repeat(layout.zoom, 0)
                assert np.corrcoef(shown.ravel(), other.repeat(layout.zoom, 1).ravel())[0, 1] < 0.5
    outlined = found[0][layout.errors(0)]
    assert (outlined[..., 2] - outlined[..., 0] > 60).any(), "the crop's outline in the whole picture"
    assert np.abs(found[0][layout.image(0)] - found[2][layout.image(0)]).mean() > 1, "it moves"


def test_panels_do_not_overlap_and_wrap_into_rows() -> None:
    layout = Layout((230, 120), 2, 3, 5, 14)
    used = np.zeros(layout.size[::-1], int)
    for cell in range(14):
        used[layout.image(cell)] += 1
        used[layout.errors(cell)] += 1
        x, y = layout.corner(cell)
        assert layout.image(cell)[0].start - y == 54, "room for two lines of a name and its scale"
    assert used.max() == 1 and used.sum() == 14 * 2 * 230 * 120
    assert layout.size[0] <= WIDEST and not any(side % 2 for side in layout.size)


def test_many_methods_stay_within_the_widest_frame(tmp_path: Path) -> None:
    results = write_results(tmp_path, {f"m{i}": 0.1 for i in range(13)})
    layout = make_layout(make_panels(results.scene, results.folders, results.records))
    assert layout.size[0] <= WIDEST and layout.columns == 5 and layout.cells == 14
