"""The page in a real browser, opened from the disk: filters, sort, address, slider, downloads, hostile names."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
import pytest
from devtools import Page, wait_for
from page_boards import CODE, MACHINE, board, cell, failed, large_board, row

from spike4dgs.benchmark.reports.error_map import error_image
from spike4dgs.benchmark.scene.images import encode_srgb, read_exr
from spike4dgs.benchmark.scene.scene import open_scene
from spike4dgs.leaderboard.page.content import board_content
from spike4dgs.leaderboard.page.intervals import compare
from spike4dgs.leaderboard.page.rows import Board, find_board, gather, titles
from spike4dgs.leaderboard.page.scores import image_scores
from spike4dgs.leaderboard.page.site import Site, write_site
from spike4dgs.leaderboard.submit import submit_all

COMMITTED = Path(__file__).resolve().parents[3] / "leaderboard"
HOSTILE = '<img src=x onerror="window.hacked=1"></script><script>window.hacked=1</script>'
OUTDOOR = "bicycle-0-small,car-0-small,jaywalk-0-small,motor-0-small,van-0-small"


def hostile_board() -> Board:
    """Every text that an entry can hold tries to run; a method is named as a key of every object."""
    first = row(HOSTILE, {"s": cell({"psnr": np.array([30.0, 31.0])})}, version=HOSTILE, trained_on=[HOSTILE])
    first.first["method"]["params"] |= {"motion": HOSTILE, "__proto__": {"polluted": 1}, "settings": {HOSTILE: HOSTILE}}
    first.first["command"] = HOSTILE
    second = row("constructor", {"s": failed(HOSTILE)}, why=HOSTILE)
    return replace(board("hostile", [first, second], title=HOSTILE), why=HOSTILE)


def sensors_board() -> Board:
    """Two methods on an ideal and a noisy scene, as the records say."""
    values = (("clean", (40.0, 20.0)), ("other", (30.0, 25.0)))
    made = [row(name, {s: cell({"psnr": np.full(3, v)}) for s, v in zip("in", of, strict=True)}) for name, of in values]
    for one in made:
        one.first["sensors"] = {"i": "ideal", "n": "noisy"}
    return board("sensors", made)


def seeds_board() -> Board:
    """Two methods on four scenes: one with three seeds."""
    rng = np.random.default_rng(5)

    def records(name: str, level: float) -> Any:
        return row(name, {f"s{i}": cell({"psnr": level + rng.normal(size=6)}) for i in range(4)})

    many = [records("many", 30) for _ in range(3)]
    return board("seeds", [replace(many[0], records=tuple(m.first for m in many)), records("one", 30.4)])


def labels_board() -> Board:
    """A re-fitted row, and a re-scored one whose LPIPS, the better one, is as claimed."""

    def of(name: str, label: str, lpips: float, unverified: list[str], refit: Any) -> Any:
        made = row(name, {"s": cell({"psnr": np.full(3, 30.0), "lpips_vgg": np.full(3, lpips)})}, label=label)
        stated = {"label": label, "unverified": unverified, "by": None, "refit": refit}
        entry = {"submitted": "2026-11-21T00:00:00Z", "verification": stated}
        return replace(made, entries={name: entry}, hashes={name: "a" * 64})

    fitted = of("fitted", "re-fitted", 0.2, [], {"apart": "process"})
    return board("labels", [of("claims", "re-scored", 0.1, ["lpips_vgg"], None), fitted])


def flags_board() -> Board:
    """Two ranked rows, a copy of the truth, a claim and an own run: the less they prove, the better and quicker."""

    def of(name: str, psnr: float, why: str = "", label: str = "re-scored") -> Any:
        cells = {"s": cell({"psnr": np.full(3, psnr)}, fit_seconds=500 / psnr)}
        return row(name, cells, label=label, ranked=not why, why=why)

    rows = [
        of("honest", 40),
        of("copy", 100, "equals truth (s)"),
        of("claim", 90, "nothing", "claimed"),
        of("other", 30),
    ]
    return board("flags", [*rows, of("own", 35, "t failed", "own run")])


def machines_board() -> Board:
    """Two rows of one machine, one of another."""

    def of(name: str, psnr: float, machine: str) -> Any:
        environment = {**MACHINE, "cpu": machine}
        made = cell({"psnr": np.full(3, psnr)}, fitted_with={"environment": environment, "harness": CODE})
        return row(name, {"s": made})

    return board("machines", [of("slow", 40, "b"), of("other", 35, "b"), of("quick", 30, "a")])


def sheets_board(finished: Path, folder: Path) -> Board:
    """The entries of a run, which have thumbnails, without the run."""
    names = ("tfp+4dgs", "rough")
    results = {finished / f"out/results/{name}.json": finished / "out/predictions" / name for name in names}
    submit_all(results, scenes=(finished / "s0", finished / "s1"), leaderboard=folder)
    ((board,), _) = gather(folder, ())
    return replace(board, name="sheets")


@pytest.fixture(scope="module")
def shown(one_browser: Page) -> Iterator[Page]:
    one_browser.forget()
    yield one_browser
    assert one_browser.errors() == [], "nothing went wrong in any of the tests"


@pytest.fixture(scope="module")
def written(finished: Path, data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Site]:
    """The committed entries, a run with images, and boards made for the tests, as one page."""
    out = tmp_path_factory.mktemp("page") / "page"
    boards, refused = gather(COMMITTED, (finished / "out",))
    sheets = sheets_board(finished, tmp_path_factory.mktemp("sheets") / "board")
    made = [seeds_board(), sensors_board(), hostile_board(), labels_board(), flags_board(), machines_board(), sheets]
    return out, write_site(out, [*boards, *made], [*refused, {"entry": HOSTILE, "reason": HOSTILE}], data)


@pytest.fixture(scope="module")
def folder(written: tuple[Path, Site]) -> Path:
    return written[0]


@pytest.fixture
def page(shown: Page, folder: Path) -> Page:
    address = (folder / "index.html").as_uri()
    if not shown.value(f"location.href.startsWith({json.dumps(address)})"):
        shown.show(address, "Boolean(document.body?.dataset.whole)", 1400, 900)
    return shown


def go(page: Page, state: str) -> None:
    """Show a state and wait until all of it is drawn."""
    page.value(f"location.hash = {json.dumps('#' + state)}")
    settle(page)


def settle(page: Page) -> None:
    wait_for("the page", lambda: page.value("document.body.dataset.whole === location.hash"))


def click(page: Page, element: str) -> None:
    page.value(f"{element}.click()")
    settle(page)


def text_of(page: Page, name: str) -> str:
    """The text of the element with that id."""
    return page.value(f"document.getElementById({name!r}).textContent")


def names(page: Page) -> list[str]:
    return page.value("[...document.querySelectorAll('#table tbody tr')].map(r => r.dataset.row)")


def column(page: Page, title: str) -> list[str]:
    """The cells of the column whose header starts so."""
    index = f"[...document.querySelectorAll('#table thead th')].findIndex(h => h.innerText.startsWith({title!r}))"
    rows = "[...document.querySelectorAll('#table tbody tr')]"
    return page.value(f"{rows}.map(r => r.cells[{index}].textContent.trim())")


def choose(page: Page, name: str, value: str) -> None:
    """Choose an option or fill a field as a person does: the change is told to the page."""
    field = f"document.querySelector('[name={name}]')"
    page.value(f"{field}.value = {json.dumps(value)}; {field}.dispatchEvent(new Event('change', {{bubbles: true}}))")
    settle(page)


def count_of(committed: list[Board], **parts: str) -> tuple[int, int]:
    """The numbers of rows of `ideal` whose methods have these parts, and of the others."""
    rows = board_content(find_board(committed, "ideal"), "ideal")["rows"]
    found = sum(all(row["parts"].get(k) == v for k, v in parts.items()) for row in rows)
    return found, len(rows) - found


def test_the_committed_entries_fit_the_first_view(written: tuple[Path, Site]) -> None:
    """And others beside them."""
    folder, site = written
    assert site.first_view_bytes < 1_500_000 and not site.left_out
    html = (folder / "index.html").read_text()
    linked = re.findall(r'(?:src|href)="([^"#]+)"', html)
    assert all((folder / name).is_file() for name in linked if not name.startswith("data:,"))
    assert not re.search(r"https?:", html.replace("http-equiv", ""))


def test_it_opens_from_the_disk_and_ranks_as_the_board_does(page: Page) -> None:
    go(page, "t=ideal")
    rows = json.loads((COMMITTED / "leaderboard.json").read_text())["boards"][0]["rows"]
    assert names(page) == [r["method"] for r in rows]
    assert [float(v) for v in column(page, "PSNR, dB")] == [round(r["mean"]["psnr"], 2) for r in rows]
    assert page.value("document.title") == "ideal: Spike4DGS leaderboard"
    assert column(page, "Rank")[0].startswith("= 1–") and "spike4dgs-x.tuned" in column(page, "Rank")[0]
    go(page, f"t=ideal&scenes={OUTDOOR}")  # PSNR of the others is not published
    assert column(page, "PSNR, paper")[0] == "–", "the paper has no such method"


def test_filters_count_what_they_hide_and_live_in_the_address(page: Page, committed: list[Board]) -> None:
    shown, hidden = count_of(committed, motion="hexplane")
    go(page, "t=ideal")
    choose(page, "motion", "hexplane")
    assert page.value("location.hash") == "#t=ideal&motion=hexplane"
    count = text_of(page, "count")
    assert f"{shown} rows; {hidden} rows hidden by filters" in count and shown > 3
    choose(page, "maxfit", "100")
    assert "tfi+4dgs" not in names(page) and "spike4dgs" in names(page)
    click(page, "document.querySelector('#count button')")
    assert page.value("location.hash") == "#t=ideal" and len(names(page)) == shown + hidden


def test_times_of_different_machines_are_marked(page: Page) -> None:
    marked = []
    for state, shown in (("", "slow other quick"), ("&hardware=b", "slow other"), ("&q=quick", "quick")):
        go(page, f"t=machines{state}")
        assert names(page) == shown.split()
        caption = page.value("document.querySelector('#table caption').textContent")
        marked.append("Fit times and images/s are of different machines: do not compare them." in caption)
    assert marked == [True, False, False]


def test_the_address_restores_everything(page: Page) -> None:
    go(page, "t=ideal&m=ssim&s=fit_seconds&d=desc&calibration=given&scenes=car-0-small,van-0-small")
    assert page.value("document.querySelector('[name=m]').value") == "ssim"
    assert page.value("document.querySelector('[name=calibration]').value") == "given"
    fits = [float(v) for v in column(page, "fit")]
    assert fits == sorted(fits, reverse=True)
    chosen = "[...document.querySelectorAll('[name=scene]:checked')].map(c => c.value)"
    assert page.value(chosen) == ["car-0-small", "van-0-small"]
    record = json.loads(next(COMMITTED.glob("entries/2-ideal@*/spike4dgs.json")).read_text())["record"]
    mean = np.mean([record["scenes"][s]["metrics"]["ssim"] for s in ("car-0-small", "van-0-small")])
    assert column(page, "SSIM")[names(page).index("spike4dgs")] == f"{mean:.4f}"


def test_headers_sort_and_say_so(page: Page) -> None:
    go(page, "t=ideal")
    header = "[...document.querySelectorAll('#table thead th')].find(h => h.innerText.startsWith('FLIP'))"
    click(page, f"{header}.querySelector('button')")
    assert page.value(f"{header}.getAttribute('aria-sort')") == "ascending", "lower is better comes first"
    flip = [float(v) for v in column(page, "FLIP")]
    assert flip == sorted(flip)
    click(page, f"{header}.querySelector('button')")
    assert [float(v) for v in column(page, "FLIP")] == sorted(flip, reverse=True)


def test_a_row_that_lacks_a_scene_has_no_mean_until_the_scene_is_left_out(page: Page) -> None:
    go(page, "t=hostile")
    assert column(page, "PSNR, dB")[names(page).index("constructor")] == "–"
    assert "incomplete: s failed" in text_of(page, "table")


def test_a_label_says_what_kept_the_second_fit_apart_and_what_that_does_not_prevent(page: Page) -> None:
    go(page, "t=labels")
    labels = dict(zip(names(page), column(page, "Verified"), strict=True))
    assert labels == {"claims": "re-scored", "fitted": "re-fitted (process)"}
    text = text_of(page, "below")
    assert "only a container (submit --refit --container) keeps a method from files" in text


def test_a_claimed_value_is_not_first_and_says_so(page: Page) -> None:
    go(page, "t=labels&m=lpips_vgg")
    assert names(page) == ["fitted", "claims"] and column(page, "LPIPS") == ["0.2000", "0.1000"]
    assert [rank[0] for rank in column(page, "Rank")] == ["1", "–"], "what is claimed has no rank"
    cells = "[...document.querySelectorAll('#table tbody tr')]"
    assert page.value(f"{cells}.map(r => r.cells[2].classList.contains('best'))") == [True, False]
    notes = page.value(f"{cells}.map(r => r.querySelector('th').textContent)")
    assert "as claimed, not computed again: LPIPS" in notes[1] and "as claimed" not in notes[0]


def test_an_entry_without_a_rank_is_below_not_the_best_and_not_on_the_front(page: Page) -> None:
    go(page, "t=flags")
    assert names(page) == ["honest", "own", "other", "copy", "claim"]
    cells = "[...document.querySelectorAll('#table tbody tr')]"
    assert page.value(f"{cells}.map(r => r.cells[2].classList.contains('best'))") == [True, *[False] * 4]
    plot = "document.querySelector('#plots figure svg')"
    assert page.value(f"{plot}.querySelectorAll('g[fill=\"#999\"] circle').length") == 2
    front = page.value(f"{plot}.querySelector('g[aria-label=line] path').getAttribute('d')")
    shown = f"[...{plot}.querySelectorAll('g:not([fill=\"#999\"]) > circle')]"
    points = page.value(f"{shown}.map(c => [Number(c.getAttribute('cy')), Number(c.getAttribute('cx'))])")
    assert [float(v) for v in re.findall(r"[\d.]+", front)][:2] == pytest.approx(min(points)[::-1], abs=0.01)
    go(page, "t=flags&s=name")
    assert names(page) == ["claim", "copy", "honest", "other", "own"]


def better_of(page: Page, name: str, scenes: list[int]) -> Any:
    """What the page's own bootstrap says of a board."""
    code = (
        f"(() => {{ const {{page}} = Spike4DGS.app.current(); const b = page.boards.findIndex(b => b.id === {name!r});"
        f"const scenes = {scenes}; const worlds = scenes.map(s => page.boards[b].worlds[s]);"
        "const values = Spike4DGS.intervals.nested(Spike4DGS.ready(`scores-${b}-psnr`), scenes);"
        "return Spike4DGS.intervals.compare(values, worlds, true, page.bootstrap).better })()"
    )
    return np.array(page.value(code))


@pytest.mark.parametrize("name", ["ideal", "small", "quick-start", "seeds"])
def test_the_pages_intervals_are_pythons(page: Page, committed: list[Board], name: str) -> None:
    go(page, f"t={name}")
    compared = seeds_board() if name == "seeds" else find_board(committed, name)
    scores = image_scores(compared, "psnr")
    every = list(range(len(compared.scenes)))
    for scenes in (every, every[:-1]):
        values = [[method[s] for s in scenes] for method in scores.values.values()]
        expected = compare(values, True, [scores.worlds[s] for s in scenes]).better
        np.testing.assert_array_equal(better_of(page, name, scenes), expected)


def test_ranks_follow_the_chosen_scenes(page: Page) -> None:
    go(page, "t=ideal&scenes=car-0-small")
    one = column(page, "Rank")
    go(page, "t=ideal&iv=fixed")
    fixed = column(page, "Rank")
    go(page, "t=ideal")
    assert fixed != column(page, "Rank") != one and fixed[0].startswith("1,"), "of these five scenes alone it is first"


def image(page: Page, pane: str) -> np.ndarray:
    """The pixels of a pane on the screen, gray."""
    frame = f"document.querySelector('#{pane} .frame')"
    page.value(f"{frame}.scrollIntoView({{block: 'center'}})")
    loaded = "[...document.querySelectorAll('.frame img')].every(i => i.complete && i.naturalWidth)"
    wait_for("images", lambda: page.value(loaded))
    box = page.value(f"(() => {{ const b = {frame}.getBoundingClientRect(); return [b.x, b.y, b.width, b.height] }})()")
    x, y, w, h = (round(v) for v in box)
    return page.screenshot()[y : y + h, x : x + w].astype(float)


def test_slider_scrubber_and_crop(page: Page, data: Path) -> None:
    own = "t=pattern-0%2B1&a=out%2Ftfp%2B4dgs&b=out%2Frough&scene=pattern-1"
    go(page, f"{own}&k=0&split=100")
    a = image(page, "pane-images")
    go(page, f"{own}&k=0&split=0")
    b = image(page, "pane-images")
    assert np.abs(a - b).mean() > 0.3
    slider = "document.querySelector('[name=split]')"
    page.value(f"{slider}.value = 50; {slider}.dispatchEvent(new Event('input'))")
    mixed, w = image(page, "pane-images"), a.shape[1]
    assert np.abs(mixed[:, : w // 2 - 6] - a[:, : w // 2 - 6]).mean() < 0.5, "A on the left"
    assert np.abs(mixed[:, w // 2 + 6 :] - b[:, w // 2 + 6 :]).mean() < 0.5, "B on the right"
    first = image(page, "pane-truth")
    page.value("document.querySelector('[name=k]').focus()")
    page.press("End")
    wait_for("the last image", lambda: "image 3 of 3" in text_of(page, "at"))
    assert np.abs(image(page, "pane-truth") - first).mean() > 1, "the pattern moves"
    assert "3.00 ms" in text_of(page, "scene-scores")
    assert "k=2" in page.value("location.hash")
    click(page, "document.querySelector('[name=crop]')")
    assert "crop=1" in page.value("location.hash")
    shape = image(page, "pane-truth").shape
    assert shape[0] / shape[1] == pytest.approx(24 / 24, abs=0.05), "a crop of 24x24 of 40x24 pixels"


def test_error_maps_are_coloured_on_the_scale_that_is_said(page: Page, data: Path, finished: Path) -> None:
    """The browser's colours are those of the reports, made from the same files."""
    scene = open_scene(data / "pattern-1")
    truth = scene.ground_truth(scene.targets[0])
    rendered = read_exr(finished / f"out/predictions/rough/{scene.id}/{scene.targets[0].name}.exr")
    own = "t=pattern-0%2B1&a=out%2Frough&b=out%2Ftfp%2B4dgs&scene=pattern-1&k=0&split=100"
    seen = []
    for choice, scale in (("1", 0.3), ("3", 0.1), ("30", 0.01)):
        go(page, f"{own}&e={choice}")
        caption = page.value("document.querySelector('#pane-errors figcaption').textContent")
        assert f"\N{MULTIPLICATION SIGN}{choice}: 0" in caption and f"{scale:g}, where 1 is white" in caption
        shown = image(page, "pane-errors")
        expected = cv2.cvtColor(error_image(rendered, truth, scale), cv2.COLOR_RGB2GRAY)
        large = cv2.resize(expected, shown.shape[::-1], interpolation=cv2.INTER_NEAREST)
        same = (slice(None), slice(None, -8))  # without the slider's bar at the right
        # the browser rounds the edges of enlarged pixels otherwise
        assert np.corrcoef(shown[same].ravel(), large[same].ravel())[0, 1] > 0.9
        assert np.median(np.abs(shown[same] - large[same])) < 4
        seen.append(shown.mean())
    assert seen[0] < seen[1] < seen[2], "a smaller scale is brighter"
    go(page, own)
    pictures = loaded(page, "pictures")
    widest = max(pictures[1]["scales"][str(r)] for r in pictures[1]["rows"])
    assert f"{widest:g}, where" in page.value("document.querySelector('#pane-errors figcaption').textContent")


def loaded(page: Page, kind: str) -> Any:
    """The data of the shown board, of that kind, as the page has them."""
    of = "Spike4DGS.app.current(); const n = c.page.boards.indexOf(c.view.board)"
    return page.value(f"(() => {{ const c = {of}; return Spike4DGS.ready(`{kind}-${{n}}`) }})()")


def test_entries_with_sheets_show_an_image_without_runs(page: Page, data: Path, finished: Path) -> None:
    """One image of each kind, the same as in the files but for the losses of the sheet; a row of it for each scene."""
    own = "t=sheets&a=rough&b=tfp%2B4dgs&split=100&e=30"
    for scene_id in ("pattern-0", "pattern-1"):
        go(page, f"{own}&scene={scene_id}")
        scene = open_scene(data / scene_id)
        truth = scene.ground_truth(scene.targets[1])
        rendered = read_exr(finished / f"out/predictions/rough/{scene_id}/{scene.targets[1].name}.exr")
        errors = cv2.cvtColor(error_image(rendered, truth, 0.01), cv2.COLOR_RGB2GRAY)
        expected = {"truth": encode_srgb(truth), "images": encode_srgb(rendered), "errors": errors}
        for pane, of in expected.items():
            seen = image(page, f"pane-{pane}")
            small = cv2.resize(seen, of.shape[::-1], interpolation=cv2.INTER_AREA)[:, :-1]  # without the slider's bar
            assert np.abs(small - of[:, :-1]).mean() < (25 if pane == "errors" else 4)
            assert np.corrcoef(small.ravel(), of[:, :-1].ravel())[0, 1] > 0.8
    text = text_of(page, "scenes")
    assert "cam_03/000040" in text and "as it comes with the entries" in text and "--runs" in text
    assert page.value("document.querySelectorAll('[name=split]').length") == 1
    assert page.value("document.querySelectorAll('[name=k]').length") == 0, "one image has no time to choose"
    first = image(page, "pane-images")
    go(page, f"{own.replace('split=100', 'split=0')}&scene=pattern-1")
    assert np.abs(image(page, "pane-images") - first).mean() > 0.3, "the other method"
    go(page, f"{own}&scene=pattern-1&crop=1")
    shape = image(page, "pane-truth").shape
    assert shape[0] / shape[1] == pytest.approx(24 / 24, abs=0.05), "a crop of 24x24 of 40x24 pixels"


def test_a_board_without_images_says_how_to_get_them(page: Page) -> None:
    go(page, "t=sensors&scene=i&a=clean&b=other")
    text = text_of(page, "scenes")
    assert "No images here" in text and "--runs" in text and "clean" in text
    assert page.value("document.querySelectorAll('.curves svg').length") == 1


def test_plots_colour_families_and_gray_out_what_is_hidden(page: Page, committed: list[Board]) -> None:
    go(page, "t=ideal&images=tfp")
    plots = page.value("[...document.querySelectorAll('#plots figure svg')].map(s => s.getAttribute('aria-label'))")
    assert plots == [f"PSNR against {c}" for c in ("fit, s", "images/s", "memory, MB", "model, MB")]
    gray = "document.querySelector('#plots figure svg').querySelectorAll('g[fill=\"#999\"] circle').length"
    assert page.value(gray) == count_of(committed, images="tfp")[1]
    (old,) = (name for of, name in zip(committed, titles(committed), strict=True) if of.name == "bicycle-0-small+4")
    go(page, f"t={quote(old)}&m=psnr_dynamic")
    assert "18.07" in text_of(page, "plots"), "the floor is named, not left out silently"


def download(page: Page, folder: Path, kind: str) -> str:
    before = set(folder.iterdir())
    page.value(f"document.querySelector('[data-kind={kind}]').click()")
    done = wait_for("download", lambda: [p for p in set(folder.iterdir()) - before if p.suffix == f".{kind}"])
    return wait_for("its text", done[0].read_text)


def test_downloads_are_what_is_shown(page: Page, tmp_path: Path, committed: list[Board]) -> None:
    hidden = count_of(committed, motion="spacetime")[1]
    page.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    go(page, "t=ideal&m=psnr_dynamic&motion=spacetime")
    lines = [line.split(",") for line in download(page, tmp_path, "csv").splitlines()]
    assert [line[lines[0].index("method")] for line in lines[1:]] == names(page)
    value = float(lines[1][lines[0].index("psnr_dynamic")])
    assert f"{value:.2f}" == column(page, "PSNR, moving")[0]
    found = json.loads(download(page, tmp_path, "json"))
    assert [r["method"] for r in found["rows"]] == names(page) and len(found["hidden_rows"]) == hidden
    assert found["view"] == page.value("location.hash")
    tex = download(page, tmp_path, "tex")
    assert tex.count("\\\\\n") == 1 + len(names(page)) and f"{hidden} rows hidden" in tex


def test_nothing_that_an_entry_holds_runs(page: Page, tmp_path: Path) -> None:
    go(page, "t=hostile")
    assert HOSTILE in names(page)
    click(page, "document.querySelector('#table button.link')")
    wait_for("details", lambda: page.value("document.getElementById('details').open"))
    text = text_of(page, "details")
    assert text.count(HOSTILE) >= 4 and "__proto__" in text
    page.press("Escape")
    wait_for("closed", lambda: not page.value("document.getElementById('details').open"))
    settle(page)
    assert page.value("window.hacked === undefined && ({}).polluted === undefined")
    assert page.value("document.querySelectorAll('main img[src=x], main script').length") == 0
    go(page, f"t=hostile&motion={HOSTILE.replace('<', '%3C').replace(' ', '%20')}")
    assert page.value("window.hacked === undefined")


def test_details_have_command_hashes_and_commit(page: Page) -> None:
    go(page, "t=ideal&row=tfp%2B4dgs")
    wait_for("details", lambda: page.value("document.getElementById('details').open"))
    text = text_of(page, "details")
    entry = json.loads(next(COMMITTED.glob("entries/2-ideal@*/tfp+4dgs.json")).read_text())["record"]
    assert entry["command"] in text and entry["harness"]["commit"] in text and entry["environment"]["cpu"] in text
    assert all(cell["predictions_sha256"] in text for cell in entry["scenes"].values())
    go(page, "t=ideal")
    assert not page.value("document.getElementById('details').open")


def test_questions_are_answered_in_one_click(page: Page) -> None:
    record: dict[str, list[Any]] = {}
    for path in COMMITTED.glob("entries/2-ideal@*/*.json"):
        record.setdefault(path.stem.partition("@")[0], []).append(json.loads(path.read_text())["record"])
    fit = {name: np.mean([c["fit_seconds"] for r in of for c in r["scenes"].values()]) for name, of in record.items()}
    moving = {name: np.mean([r["mean"]["psnr_dynamic"] for r in of]) for name, of in record.items()}
    quick = sorted((n for n in fit if fit[n] <= 60), key=lambda n: -moving[n])
    uncalibrated = [n for n in quick if "flat-field" not in record[n][0]["method"].get("given", ["flat-field"])]
    for text, expected in (("on a noisy sensor", quick), ("not calibrated", uncalibrated)):
        go(page, "t=quick-start")
        link = f"[...document.querySelectorAll('#questions a')].find(a => a.textContent.includes('{text}'))"
        click(page, link)
        assert names(page) == expected and expected
        hidden = f"{len(record) - len(expected)} rows hidden"
        assert hidden in text_of(page, "count")
        assert page.value("document.querySelector('[name=sensor]').value") == "noisy"
        assert "sensor is noisy" in text_of(page, "about")


def test_the_sensor_filters_scenes_and_hides_all_rows_where_no_scene_has_it(page: Page, committed: list[Board]) -> None:
    every = sum(count_of(committed))
    go(page, "t=sensors&sensor=ideal")
    assert column(page, "PSNR, dB") == ["40.00", "30.00"] and names(page) == ["clean", "other"]
    assert "(1 of 2)" in page.value("document.querySelector('#controls legend').textContent")
    choose(page, "sensor", "noisy")
    assert column(page, "PSNR, dB") == ["25.00", "20.00"] and names(page) == ["other", "clean"]
    choose(page, "sensor", "")
    assert column(page, "PSNR, dB") == ["30.00", "27.50"]
    go(page, "t=ideal&sensor=recorded")
    assert names(page) == [] and f"{every} rows hidden" in text_of(page, "count")
    click(page, "document.querySelector('#count button')")
    assert len(names(page)) == every


def as_html(markdown: str) -> str:
    """A page of documentation with its links, as far as a browser needs it."""
    link = r"\[([^\]]+)\]\(([^)]+?)\)"  # its text may go on in the next line
    linked = re.sub(link, lambda m: f'<a href="{m[2]}">{" ".join(m[1].split())}</a>', markdown)
    pages = re.sub(r'(href="(?!http)[^"#]*)\.md', r"\1.html", linked)
    return f"<meta charset=utf-8><body>{pages}"


def test_from_the_readme_to_the_answer_in_four_clicks(shown: Page, folder: Path, tmp_path: Path) -> None:
    """Which method is best where things move, within a minute of fit, on a noisy sensor? Click after click."""
    root = COMMITTED.parent
    for path in ("README.md", "docs/leaderboard.md"):
        target = (tmp_path / path).with_suffix(".html")
        target.parent.mkdir(exist_ok=True)
        target.write_text(as_html((root / path).read_text(encoding="utf-8")), encoding="utf-8")
    shutil.copytree(folder, tmp_path / "leaderboard_page")
    shown.show((tmp_path / "README.html").as_uri(), "document.readyState === 'complete'", 1400, 900)
    clicks = ("leaderboard's page", "The page of the committed entries", "and on a noisy sensor")
    for text in clicks:
        link = f"[...document.querySelectorAll('a')].find(a => a.textContent.includes({json.dumps(text)}))"
        before = shown.value("location.href")
        wait_for(text, lambda link=link: shown.value(f"Boolean({link})"))
        shown.value(f"{link}.click()")
        wait_for("the next page", lambda before=before: shown.value("location.href") != before)
    assert len(clicks) <= 4
    wait_for("the page", lambda: shown.value("Boolean(document.body?.dataset.whole)"))
    settle(shown)
    first = "[...document.querySelectorAll('#table tbody tr')][0].dataset.row"
    assert shown.value(first) == "spike4dgs-x"
    assert shown.value("document.querySelector('#table th[aria-sort]').innerText").startswith("PSNR, moving")


def test_keys_labels_and_a_narrow_screen(page: Page) -> None:
    said = "e.labels?.length || e.tagName === 'BUTTON' && e.textContent.trim()"
    labels = "e.getAttribute('aria-label') || e.getAttribute('aria-labelledby')"
    what = "input, select, button, [role=img], dialog, nav, section"
    unnamed = f"[...document.querySelectorAll('{what}')].filter(e => !({said} || {labels})).map(e => e.outerHTML)"
    for state in ("t=pattern-0%2B1", "t=sheets", "t=sensors"):  # with images, with thumbnails, and without
        go(page, state)
        assert page.value(unnamed) == []
    page.value("document.getElementById('skip').focus()")
    reached, active = set(), "document.activeElement"
    for _ in range(12):
        page.press("Tab")
        reached.add(page.value(f"{active}.closest('nav, form, main, body').id || {active}.id"))
    assert {"questions", "tabs"} <= reached
    for width in (390, 800, 1400):
        page.call("Emulation.setDeviceMetricsOverride", width=width, height=800, deviceScaleFactor=1, mobile=False)
        assert page.value("document.documentElement.scrollWidth") <= width, "only the table scrolls sideways"


def test_many_rows_are_filtered_and_drawn_in_part(shown: Page, tmp_path: Path) -> None:
    write_site(tmp_path / "page", [large_board(400, 3, 20)])
    shown.show((tmp_path / "page/index.html").as_uri(), "Boolean(document.body?.dataset.whole)", 1400, 900)
    go(shown, "motion=static&images=tfi")
    # a third of the rows, every second of them
    assert text_of(shown, "count").startswith("67 rows, the first 50 drawn; 333 rows hidden")


def test_a_screen_in_the_dark(page: Page) -> None:
    go(page, "t=ideal")
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "dark"}])
    page.value("scrollTo(0, 0)")
    dark = page.screenshot()
    page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
    light = page.screenshot()
    assert np.median(dark) < 60 and np.median(light) > 200
    assert cv2.Canny(dark, 50, 150).mean() > 0.5, "and something is on it"
