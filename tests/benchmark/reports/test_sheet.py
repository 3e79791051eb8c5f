"""The sheet: every pixel is a scored one, scales are what they say, and text is text and inside the page."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.text import Text
from pypdf import PdfReader
from sheets import Results, write_results

from spike4dgs.benchmark.reports import sheet_video
from spike4dgs.benchmark.reports.error_map import OFF_SCALE, SCALES, absolute_error
from spike4dgs.benchmark.reports.panels import SMALLEST, Panels, bounds, crops, make_panels
from spike4dgs.benchmark.reports.sheet import make_sheet, write_sheet
from spike4dgs.benchmark.reports.sheet_video import FPS, WIDEST, Layout, make_layout, write_sheet_video
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr

NOISE = {"worse": 0.15, "spk2img+colmap+spacetime-with-a-very-long-name+again": 0.02, "fine": 0.003}
REASON = "ValueError: " + "no luck with this one, which has a long story; " * 40


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    return write_results(tmp_path_factory.mktemp("results"), NOISE, {"bad": REASON})


@pytest.fixture(scope="module")
def panels(results: Results) -> Panels:
    return make_panels(results.scene, results.folders, results.records)


@pytest.fixture(scope="module")
def figure(panels: Panels) -> Figure:
    return make_sheet(panels)


def images(figure: Figure) -> list[np.ndarray]:
    return [np.asarray(i.get_array()) for axes in figure.axes for i in axes.images]


def texts(figure: Figure) -> list[Text]:
    every = [*figure.texts, *(t for a in figure.axes for t in a.get_yticklabels(which="both"))]
    return [t for t in every if t.get_text() and t.get_visible()]


def test_panels_are_the_crops_of_what_was_scored(results: Results, panels: Panels, figure: Figure) -> None:
    shown = images(figure)
    box = panels.boxes[0]
    assert panels.size == (24, 24) and panels.is_cropped
    for k, target in enumerate(results.scene.targets):
        assert box.of(results.scene.moving(target)).sum() == results.scene.moving(target).sum(), "nothing is cut off"
        truth = results.scene.ground_truth(target)
        for name in NOISE:
            image = read_exr(results.folders[name] / f"{target.name}.exr")
            part = encode_srgb(image)[box.y : box.y + 24, box.x : box.x + 24]
            assert any(np.array_equal(part, other) for other in shown), f"{name} at {k}"
        assert any(np.array_equal(encode_srgb(truth), other) for other in shown), "the whole picture, too"
    rectangles = [p for a in figure.axes for p in a.patches if isinstance(p, Rectangle)]
    assert [(r.get_x() + 0.5, r.get_y() + 0.5, r.get_width(), r.get_height()) for r in rectangles] == [tuple(box)] * 3


def test_the_scale_is_the_one_that_is_shown(results: Results, panels: Panels, figure: Figure) -> None:
    assert panels.scales == {"worse": 0.3, list(NOISE)[1]: 0.1, "fine": 0.01}
    target, box = results.scene.targets[1], panels.boxes[1]
    truth = box.of(results.scene.ground_truth(target))
    for name, scale in panels.scales.items():
        every = [absolute_error(panels.render(name, k), panels.truth(k)) for k in range(3)]
        beyond = [np.mean(np.stack(every) > s) for s in SCALES]
        assert beyond[SCALES.index(scale)] <= OFF_SCALE or scale == max(SCALES)
        assert all(b > OFF_SCALE for b, s in zip(beyond, SCALES, strict=True) if s < scale), "the smallest that does"
        image = box.of(read_exr(results.folders[name] / f"{target.name}.exr"))
        error = np.abs(image.clip(0, 1) - truth.clip(0, 1))
        expected = colormaps["magma"](np.clip(error / scale, 0, 1))[..., :3] * 255
        shown = min((i for i in images(figure) if i.shape == expected.shape), key=lambda i: abs(i - expected).max())
        assert np.abs(shown - expected).max() < 8, "half a step of 255 colours"
    bars = [a for a in figure.axes if any(t.get_text() == "0" for t in a.get_yticklabels())]
    assert [tops(bar) for bar in bars] == ["0.3", "0.1", "0.01"]
    assert [bar.get_ylim()[1] for bar in bars] == [0.3, 0.1, 0.01]
    names = [t.get_text() for t in figure.texts if t.get_text().startswith("error \N{MULTIPLICATION SIGN}")]
    assert names == [f"error \N{MULTIPLICATION SIGN}{k}" for k in (1, 3, 30)]


def tops(bar: Axes) -> str:
    return [str(t.get_text()) for t in bar.get_yticklabels()][-1]


def test_nothing_is_cut_off_and_no_text_lies_on_another(figure: Figure) -> None:
    page = figure.bbox
    boxes = [(t.get_text(), t.get_window_extent()) for t in texts(figure)]
    assert len(boxes) > 20
    for text, box in boxes:
        assert page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1, text
    for i, (text, a) in enumerate(boxes):
        for other, b in boxes[i + 1 :]:
            width, height = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
            assert width <= 0 or height <= 2, f"{text} | {other}"  # boxes have room for letters below the line
    for axes in figure.axes:
        for text, box in boxes:
            if text.split()[0] in "".join(NOISE):
                assert not axes.bbox.overlaps(box) or box.x0 >= axes.bbox.x1 or box.x1 <= axes.bbox.x0, text


def test_the_pdf_has_text_as_text_inside_its_page(tmp_path: Path) -> None:
    method = list(NOISE)[1]
    results = write_results(tmp_path, {method: NOISE[method]}, {"bad": REASON})
    write_sheet(tmp_path / "sheet.png", results.scene, results.folders, results.records)
    page = PdfReader(tmp_path / "sheet.pdf").pages[0]
    found: list[tuple[str, float, float]] = []

    def visit(text: str, cm: Any, tm: list[float], font: Any, size: float) -> None:
        if text.strip():
            found.append((text.strip(), tm[4] * cm[0] + cm[4], tm[5] * cm[3] + cm[5]))

    page.extract_text(visitor_text=visit)
    together = "".join(text for text, _, _ in found).replace("\n", "")
    for name in (method, "ground truth", "bad", "failed: ValueError: no luck", "PSNR 33.98 dB, moving 32.98 dB"):
        assert name in together
    assert all(0 <= x <= page.mediabox.width and 0 <= y <= page.mediabox.height for _, x, y in found)
    embedded = {i.image.size for i in page.images if i.image}
    assert (24, 24) in embedded, "images keep their own pixels"
    before = (tmp_path / "sheet.pdf").read_bytes()
    write_sheet(tmp_path / "sheet.png", results.scene, results.folders, results.records)
    assert (tmp_path / "sheet.pdf").read_bytes() == before, "the same sheet is the same file"


def test_a_sheet_of_many_methods_grows(tmp_path: Path) -> None:
    many = write_results(tmp_path, {f"method+{i:02d}": 0.02 for i in range(8)})
    figure = make_sheet(make_panels(many.scene, many.folders, many.records))
    shown = {t.get_text() for t in figure.texts}
    assert all(f"method+{i:02d}" in shown for i in range(8))
    rows = sorted({round(a.bbox.y0) for a in figure.axes})
    assert len(rows) == 9 and min(np.diff(rows)) > 150, "each as large as in a small sheet"
    test_nothing_is_cut_off_and_no_text_lies_on_another(figure)


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.floats(0.0005, 0.2))
def test_every_crop_contains_its_mask_and_all_have_one_size(seed: int, count: int, density: float) -> None:
    rng = np.random.default_rng(seed)
    height, width = (int(v) for v in rng.integers(8, 90, 2))
    masks = [rng.random((height, width)) < density * rng.integers(0, 2) for _ in range(count)]
    found = crops(masks)
    assert [box is None for box in found] == [not mask.any() for mask in masks]
    boxes = [box for box in found if box]
    assert len({(box.width, box.height) for box in boxes}) <= 1
    for mask, box in zip(masks, found, strict=True):
        if box:
            assert box.of(mask).sum() == mask.sum() and box.of(mask).shape == (box.height, box.width)
            assert box.x >= 0 and box.y >= 0 and box.x + box.width <= width and box.y + box.height <= height


def test_a_crop_stands_still_where_the_motion_is_small_and_follows_where_it_is_large() -> None:
    def clip(step: int) -> list[np.ndarray]:
        masks = [np.zeros((80, 400), bool) for _ in range(4)]
        for k, mask in enumerate(masks):
            mask[20:50, 10 + step * k : 60 + step * k] = True
        return masks

    still, following = crops(clip(2)), crops(clip(90))
    assert len(set(still)) == 1 and still[0] is not None and still[0].width == round(56 * 1.3)
    assert len(set(following)) == 4 and following[0] is not None and following[0].width == 65, "50 and its margins"
    # The left edge is 7.5 pixels before what moves, but for the first, which the image's edge stops.
    assert [box.x for box in following if box] == [3, 93, 183, 273]


def test_crops_hold_some_context_and_end_with_the_image() -> None:
    masks = [np.zeros((60, 90), bool) for _ in range(3)]
    masks[0][5:15, 0:30] = masks[1][30:60, 70:80] = True
    found = crops(masks)
    assert found[2] is None and found[0] is not None and found[0][2:] == (39, 39)
    small = np.zeros((60, 90), bool)
    small[10, 10] = True
    assert crops([small])[0] == (0, 0, SMALLEST, SMALLEST)
    assert bounds(small) == (10, 10, 1, 1) and bounds(np.zeros((2, 2), bool)) is None


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
    layout = Layout((230, 120), 2, 3, 5, 14, 2)
    used = np.zeros(layout.size[::-1], int)
    for cell in range(14):
        used[layout.image(cell)] += 1
        used[layout.errors(cell)] += 1
        x, y = layout.corner(cell)
        assert layout.image(cell)[0].start - y == 54, "room for two lines of a name and its scale"
    assert used.max() == 1 and used.sum() == 14 * 2 * 230 * 120
    assert layout.size[0] <= WIDEST and not any(side % 2 for side in layout.size)


def test_the_legend_is_whole_below_one_method(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    results = write_results(tmp_path, {"m": 0.1})
    panels, drawn = make_panels(results.scene, results.folders, results.records), []
    monkeypatch.setattr(sheet_video, "PANEL", 120)
    monkeypatch.setattr(sheet_video, "_with_text", lambda frame, lines: drawn.extend(lines) or frame)
    layout = make_layout(panels)
    sheet_video._ground(panels, layout)
    end = max(layout.errors(cell)[0].stop for cell in range(layout.cells))
    legend = [(y, text) for _, y, text in drawn if y >= end]
    assert " ".join(text for _, text in legend).endswith(
        "Errors: |render - truth| of linear radiance, black is 0, 1 is white in the image."
    )
    assert len(legend) == layout.foot > 2 and legend[-1][0] + sheet_video.LINE <= layout.size[1]


def test_many_methods_stay_within_the_widest_frame(tmp_path: Path) -> None:
    results = write_results(tmp_path, {f"m{i}": 0.1 for i in range(13)})
    layout = make_layout(make_panels(results.scene, results.folders, results.records))
    assert layout.size[0] <= WIDEST and layout.columns == 5 and layout.cells == 14
