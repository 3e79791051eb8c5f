"""The text of pages that is made of records: tables, leads, and what stands behind them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import combinations

from spike4dgs.benchmark.files import sha256_json
from spike4dgs.benchmark.method import make_budget
from spike4dgs.studies.kit.timing import markdown
from spike4dgs.studies.results.changes import incomplete_lines, kind_of, unmeasured_lines
from spike4dgs.studies.results.comparison import BOTH, RANKED_BY, MeasuredRow, Ranking, lead, rank, rows_of
from spike4dgs.studies.results.plan import ALL_ROWS, KNOWLEDGE, TABLE1, TABLE2, Group, cells_of
from spike4dgs.studies.results.records import DIGITS, NOT_FINITE, Record

NOTHING = "No cell of this table has been measured yet."
NO_LEAD = "No row of ours and another with equal knowledge have been measured on all scenes yet."
NINE = Group("nine-scenes", "The nine scenes", (*TABLE1.scenes, *TABLE2.scenes), ALL_ROWS)
SMALL_NETWORK = "`spk2img` is a small network that we trained: width 8, published 64, and 2,500 steps."
_HEADS = ("rank", "row", "PSNR, moving", "behind the first, dB", "PSNR", "SSIM", "FLIP", "fit, s", "images/s", "seeds")
_LEADS = ((RANKED_BY, "where things move"), ("psnr", "in the whole image"))
RANKS = (
    "Ranks are by PSNR where things move; rows that the intervals cannot tell apart share ranks. The number after ± is "
    "half of the 95 % interval of the paired difference over worlds, which holds for all rows of a block at once."
)
_LEGEND = f"{RANKS} Times in parentheses were measured while other programs ran."


def table_block(group: Group, records: Sequence[Record]) -> list[str]:
    """Return the lines of a group's table: a block for each knowledge, means over scenes, ranks with ties."""
    own = of_group(group, records)
    if not own:
        return [NOTHING]
    lines = []
    for knowledge, rows, ranking in _blocks(group, own):
        lines += [f"**{knowledge.capitalize()}**: {KNOWLEDGE[knowledge]}. Means of {len(group.scenes)} scenes.", ""]
        if ranking.rows:
            lines += [*markdown(_HEADS, _cells(ranking)), ""]
        lines += incomplete_lines(rows)
    lines += unmeasured_lines(group, own)
    return [*lines, _LEGEND, "", provenance(own, group)]


def scenes_block(group: Group, records: Sequence[Record]) -> list[str]:
    """Return the lines of a group's table scene by scene: PSNR where things move, and of the whole image."""
    own = of_group(group, records)
    if not own:
        return [NOTHING]
    lines = []
    for knowledge, rows, ranking in _blocks(group, own):
        ranked = [*ranking.rows, *(row for row in rows if not row.is_complete)]
        texts = [
            [f"`{row.name}`", *(psnr_texts(row, scene, (RANKED_BY, "psnr")) for scene in group.scenes)]
            for row in ranked
        ]
        heads = ("row", *(scene.partition("-")[0] for scene in group.scenes))
        title = f"**{knowledge.capitalize()}**: PSNR where things move / of the whole image, dB, means over seeds."
        lines += [title, "", *markdown(heads, texts), ""]
    return [*lines, provenance(own, group)]


def lead_block(group: Group, records: Sequence[Record]) -> list[str]:
    """Return a sentence for each row of ours, best first: its lead over the best other row that is given as much."""
    own = of_group(group, records)
    sentences = [
        f"- `{row.name}`, {knowledge}: {_lead_text(row, rivals)}."
        for knowledge, rows, rivals in _leaders(group, own)
        for row in rows
    ]
    if not sentences:
        return [NO_LEAD if own else NOTHING]
    intro = (
        f"Against the best row of others with equal knowledge, in the mean of {len(group.scenes)} scenes. After ± is "
        "half of a 95 % interval of the paired difference over worlds:"
    )
    return [intro, "", *sentences, "", provenance(own, group)]


def headline_block(group: Group, records: Sequence[Record]) -> list[str]:
    """Return a sentence for each knowledge: the lead of the best row of ours."""
    own = of_group(group, records)
    lines = [
        f"- {knowledge}, `{rows[0].name}`: {_lead_text(rows[0], rivals)}."
        for knowledge, rows, rivals in _leaders(group, own)
    ]
    return [*lines, "", f"{commits_text(own)}."] if lines else [NO_LEAD if own else NOTHING]


def home_block(records: Sequence[Record]) -> list[str]:
    """Return a short table of the nine scenes: of each knowledge the best row, the paper's own, the best of others."""
    own = of_group(NINE, records)
    ours = {row.name for row in NINE.rows if row.ours}
    lines = []
    for knowledge, _, ranking in _blocks(NINE, own):
        kinds = (
            [row for row in ranking.rows if row.name in ours and row.name.startswith("spike4dgs-x")],
            [row for row in ranking.rows if row.name == "spike4dgs"],
            [row for row in ranking.rows if row.name not in ours],
        )
        lines += [[f"`{rows[0].name}`", knowledge, *_scores(rows[0])] for rows in kinds if rows]
    heads = ("row", "given", "PSNR, dB", "PSNR where things move, dB", "SSIM", "FLIP (less is better)")
    return [*markdown(heads, lines), "", f"{commits_text(own)}; {_processors(own)}."] if lines else [NOTHING]


def of_group(group: Group, records: Iterable[Record]) -> list[Record]:
    """Return the records of a group's cells, failed ones too; further seeds are of other groups."""
    budget, seeds = make_budget(group.budget).label, {row.name: row.seeds for row in group.rows}
    return [
        r
        for r in records
        if r["seed"] < seeds.get(r["row"], 0)
        and r["scene"] in group.scenes
        and (r["budget"], r["split"]) == (budget, group.split)
    ]


def measured_part(group: Group, own: Iterable[Record]) -> Group:
    """Return a group with those of its scenes that its first row, measured first, has records of, failed ones too."""
    there = {record["scene"] for record in own if record["row"] == group.rows[0].name}
    return replace(group, scenes=tuple(scene for scene in group.scenes if scene in there))


def _blocks(group: Group, own: Sequence[Record]) -> list[tuple[str, list[MeasuredRow], Ranking]]:
    """Return each knowledge with its rows, in the plan's order, and the ranking of the complete ones."""
    found = []
    for knowledge in KNOWLEDGE:
        records = [r for r in own if r["knowledge"] == knowledge]
        there = {r["row"] for r in records}
        rows = rows_of([row.name for row in group.rows if row.name in there], group.scenes, records)
        if rows:
            found.append((knowledge, rows, rank([row for row in rows if row.is_complete])))
    return found


def _leaders(group: Group, own: Sequence[Record]) -> list[tuple[str, list[MeasuredRow], list[MeasuredRow]]]:
    """Return each knowledge of which there are both with its complete rows, ours and those of others, best first."""
    ours = {row.name for row in group.rows if row.ours}
    found = []
    for knowledge, _, ranking in _blocks(group, own):
        mine, rivals = ([row for row in ranking.rows if (row.name in ours) is which] for which in (True, False))
        if mine and rivals:
            found.append((knowledge, mine, rivals))
    return found


def _cells(ranking: Ranking) -> list[list[str]]:
    parts = zip(ranking.rows, behind_texts(ranking), ranking.ranks, strict=True)
    return [
        [
            ranks,
            f"`{row.name}`",
            moving,
            behind,
            psnr,
            *others,
            _time(row, "fit_seconds"),
            _time(row, "render_fps"),
            str(len(row.seeds)),
        ]
        for row, behind, ranks in parts
        for psnr, moving, *others in [_scores(row)]
    ]


def behind_texts(ranking: Ranking) -> list[str]:
    """Return how far each row is behind the first, with half of its interval; nothing for the first."""
    return ["", *map(_interval, ranking.behind[1:], ranking.half_widths[1:])]


def _scores(row: MeasuredRow) -> list[str]:
    return [metric_text(row.mean(m), digits) for m, digits in (("psnr", 2), (RANKED_BY, 2), ("ssim", 4), ("flip", 3))]


def metric_text(value: float | None, digits: int) -> str:
    """Return a value with so many digits; "-" where there is none."""
    return "-" if value is None else f"{value:.{digits}f}"


def _interval(value: float, half: float) -> str:
    return f"{value:.2f} ± {half:.2f}" if math.isfinite(half) else f"{value:.2f}"


def _time(row: MeasuredRow, name: str) -> str:
    text = metric_text(row.mean_cost(name), 0)
    return text if row.is_quiet or text == "-" else f"({text})"


def psnr_texts(row: MeasuredRow, scene: str, metrics: Sequence[str] = BOTH) -> str:
    """Return metrics of a scene, means over seeds; "-" where there are none.

    Of a complete row, over those seeds that its means are of.
    """
    cells = [r["metrics"] for (s, seed), r in row.cells.items() if s == scene and seed in (row.seeds or [seed])]
    means = []
    for metric in metrics:
        known = [m[metric] for m in cells if metric in m]
        means.append(metric_text(sum(known) / len(known) if known else None, 2))
    return " / ".join(means) if cells else "-"


def both_text(row: MeasuredRow) -> str:
    """Return PSNR of the whole image and where things move, means over scenes and seeds; "-" of an incomplete row."""
    return " / ".join(metric_text(row.mean(metric), 2) for metric in BOTH) if row.is_complete else "-"


def _lead_text(row: MeasuredRow, rivals: Sequence[MeasuredRow]) -> str:
    parts = []
    for metric, where in _LEADS:
        if (found := lead(row, rivals, metric)) is not None:
            size = _interval(abs(found.difference), found.half_width)
            if not found.is_significant:
                parts.append(f"even with `{found.rival}` {where} ({_interval(found.difference, found.half_width)} dB)")
            else:
                side = "ahead of" if found.difference > 0 else "behind"
                parts.append(f"{size} dB {side} `{found.rival}` {where}")
    return ", and ".join(parts)


def provenance(own: Sequence[Record], *groups: Group) -> str:
    """Return one paragraph: commits, scenes, processors, seeds, budget, how many of the planned cells, tuning."""
    measured = [r for r in own if r["error"] is None]
    seeds = sorted({r["seed"] for r in measured})
    scenes = {r["scene"]: r["revision"] for r in own}
    planned = len(cells_of(groups))
    budgets = list(dict.fromkeys(group.budget for group in groups))
    facts = [
        commits_text(own),
        f"revisions of {len(scenes)} scenes {sha256_json(scenes)[:DIGITS]}",
        _processors(own),
        f"seed{'s' * (len(seeds) > 1)} {', '.join(map(str, seeds)) or '-'}",
        f"budget{'s' * (len(budgets) > 1)} {', '.join(budgets)}",
        f"{len(measured)} of {planned} planned cells{_finite(own)}",
    ]
    elsewhere = sum("equivalent" in r for r in measured)
    facts += [f"{elsewhere} of them on scenes that differ from the release's by rounding"] if elsewhere else []
    small = [SMALL_NETWORK] if any(r["row"].startswith("spk2img") for r in own) else []
    return " ".join([f"{'; '.join(facts)}.", *_mixed_code(own), _tuning(own), *small])


def _finite(own: Sequence[Record]) -> str:
    """Return whether all measured values are finite, and how many cells have another reason and no values."""
    errors = [r["error"] for r in own if r["error"] is not None]
    odd = sum(error.startswith(NOT_FINITE) for error in errors)
    finite = f", {odd} not finite" if odd else ", all finite"
    return finite + f", and {len(errors) - odd} that failed" * (len(errors) > odd)


def _processors(own: Iterable[Record]) -> str:
    return " and ".join(sorted({r["cpu"] for r in own}))


def commits_text(own: Iterable[Record]) -> str:
    """Return the commits of records in words."""
    commits = sorted({_commit(r) for r in own})
    return f"Commit{'s' * (len(commits) > 1)} {', '.join(commits)}"


def _commit(record: Record) -> str:
    return f"{record['commit']}{' with changes' if record.get('dirty') else ''}"


def _mixed_code(own: Iterable[Record]) -> list[str]:
    """Return a sentence that names the rows of each commit where the methods' code differs between them.

    Digests of two kinds cannot be compared: of ours alone, or of others alone, two commits then count as other code.
    """
    codes: dict[str, set[tuple[tuple[str, ...], str, str]]] = {}
    by_commit: dict[str, dict[str, None]] = {}
    for r in own:
        kind, commit = kind_of(r["row"]), _commit(r)
        codes.setdefault(kind[0], set()).add((kind, commit, r["code"]))
        by_commit.setdefault(commit, {})[f"`{r['row']}`"] = None
    pairs = (pair for found in codes.values() for pair in combinations(found, 2))
    if not any(a[2] != b[2] and (a[0] == b[0] or a[1] != b[1]) for a, b in pairs):
        return []
    texts = [f"{commit}: {', '.join(rows)}" for commit, rows in by_commit.items()]
    return [f"**The methods' code differs**: {'; '.join(texts)}."]


def _tuning(own: Iterable[Record]) -> str:
    """Return a sentence on what the rows were tuned on; those of the most common answer are "the others"."""
    rows: dict[str, list[str]] = {}
    for name, on in sorted({(r["row"], r["tuned_on"]) for r in own}):
        rows.setdefault(on, []).append(f"`{name}`")
    common = max(rows, key=lambda on: len(rows[on]))
    order = sorted(rows, key=lambda on: (on == common, on))
    if len(rows) == 1:
        return f"Tuned on: {common}."
    texts = [f"{on} ({'the others' if on == common else ', '.join(rows[on])})" for on in order]
    return f"Tuned on: {'; '.join(texts)}."
