"""Charts as inline SVG: they follow the page's colours, light or dark, and stay sharp at every size."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape

from spike4dgs.benchmark.reports.html_page import COLORS, Html, text

_GAP = 0.09  # share of a logarithmic axis below its smallest power, where a zero stands
_ROOM = 0.04  # share of a linear axis beyond the values


@dataclass(frozen=True)
class Scale:
    """An axis: `low` and `high` are values, or their logarithms. Exact twins have no error: a log axis shows zeros."""

    log: bool
    low: float
    high: float
    zero: bool  # the axis is logarithmic and has zeros

    def at(self, value: float) -> float:
        """Return the place of a value, 0 to 1."""
        start = _GAP if self.zero else 0.0
        if self.log and value <= 0:
            return 0.0
        along = ((math.log10(value) if self.log else value) - self.low) / (self.high - self.low)
        return start + (1 - start) * along

    def ticks(self) -> list[float]:
        """Return three to seven values to name."""
        if not self.log:
            step = _nice((self.high - self.low) / 4)
            first = math.ceil(self.low / step - 1e-9)
            return [k * step for k in range(first, math.floor(self.high / step + 1e-9) + 1)]
        low, high = math.ceil(self.low - 1e-9), math.floor(self.high + 1e-9)
        step = max(1, math.ceil((high - low) / 5))
        powers = [10.0**k for k in range(low, high + 1, step)]
        if self.high - self.low <= 2:
            inside = (m * 10.0**k for k in range(low - 1, high + 1) for m in (1, 2, 5))
            powers = [v for v in inside if self.low - 1e-9 <= math.log10(v) <= self.high + 1e-9]
        return [0.0] * self.zero + powers


def scale_of(values: Sequence[float], log: bool) -> Scale:
    """Return an axis that shows all values; negative ones are not for a logarithmic axis."""
    if log and any(v > 0 for v in values):
        powers = [math.log10(v) for v in values if v > 0]
        low, high = min(powers), max(powers)
        room = max(0.2, _ROOM * (high - low))  # a range of 0.4 has a 1, a 2 or a 5 in it
        low, high = low - room, high + room
        if high - low > 2:  # whole powers at both ends
            low, high = math.floor(low + 0.3), math.ceil(high - 0.3)
            low, high = min(low, min(powers) - room), max(high, max(powers) + room)
        return Scale(True, low, high, any(v <= 0 for v in values))
    low, high = min(0.0, *values, 0.0), max(0.0, *values, 0.0)
    if low == high:
        return Scale(False, 0.0, 1.0, False)
    room = _ROOM * (high - low)
    return Scale(False, low - (room if low < 0 else 0.0), high + room, False)


def short(value: float) -> str:
    """Return a number of three digits at most, such as 0, 0.25, 12, 3000, 2e-7."""
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        return f"{value:.3g}" if abs(value) < 999.5 else f"{value:.0f}"
    mantissa, _, power = f"{value:.1e}".partition("e")
    return f"{mantissa.removesuffix('.0')}e{int(power)}"


def _nice(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step))
    return float(min((m * power for m in (1, 2, 5, 10)), key=lambda s: abs(s - step)))


WIDTH, HEIGHT = 400, 270  # px at the usual size: a phone shows them almost as large
LEFT, RIGHT, TOP, BOTTOM = 54, 14, 12, 40
LETTER, LINE = 5.9, 12  # px of a label's letter and line


@dataclass(frozen=True)
class Dot:
    """A point of a curve. A `chosen` one has a ring; `name` stands beside it where there is room."""

    x: float
    y: float
    name: str = ""
    chosen: bool = False


@dataclass(frozen=True)
class Curve:
    """Points that a line joins, in their order."""

    name: str
    dots: tuple[Dot, ...]


@dataclass(frozen=True)
class Axis:
    """A title with its unit, and whether the axis is logarithmic."""

    title: str
    log: bool = True


def chart(curves: Sequence[Curve], x: Axis, y: Axis, what: str) -> Html:
    """Return the SVG of curves with a legend below, or a sentence where there is no point.

    `what` says in words what is shown, for those who do not see it.
    """
    dots = [dot for curve in curves for dot in curve.dots]
    if not dots:
        return Html(f'<p class="soft">{text("Nothing was measured.")}</p>')
    across, up = scale_of([d.x for d in dots], x.log), scale_of([d.y for d in dots], y.log)
    parts = [*_axes(across, up, x, y), *_curves(curves, across, up), *_names(curves, across, up)]
    svg = f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(what)}">{"".join(parts)}</svg>'
    return Html(svg + (legend([c.name for c in curves]) if len(curves) > 1 else ""))


def legend(names: Sequence[str]) -> Html:
    """Return the names of curves beside their colours."""
    items = (
        f'<li><span class="swatch" style="background:{_color(i)}"></span>{text(name)}</li>'
        for i, name in enumerate(names)
    )
    return Html(f'<ul class="legend">{"".join(items)}</ul>')


def _axes(across: Scale, up: Scale, x: Axis, y: Axis) -> Iterator[str]:
    for value in across.ticks():
        px = _x(across, value)
        yield f'<line class="grid-line" x1="{px:.1f}" x2="{px:.1f}" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>'
        at = f'x="{px:.1f}" y="{HEIGHT - BOTTOM + 14}"'
        yield f'<g class="axis"><text {at} text-anchor="middle">{short(value)}</text></g>'
    for value in up.ticks():
        py = _y(up, value)
        yield f'<line class="grid-line" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>'
        yield f'<g class="axis"><text x="{LEFT - 5}" y="{py + 4:.1f}" text-anchor="end">{short(value)}</text></g>'
    middle = (LEFT + WIDTH - RIGHT) / 2
    yield f'<text class="title" x="{middle:.0f}" y="{HEIGHT - 8}" text-anchor="middle">{escape(x.title)}</text>'
    turn = f"rotate(-90 11 {(TOP + HEIGHT - BOTTOM) / 2:.0f})"
    at = f'x="11" y="{(TOP + HEIGHT - BOTTOM) / 2:.0f}" transform="{turn}"'
    yield f'<text class="title" {at} text-anchor="middle">{escape(y.title)}</text>'


def _curves(curves: Sequence[Curve], across: Scale, up: Scale) -> Iterator[str]:
    for i, curve in enumerate(curves):
        at = [(_x(across, d.x), _y(up, d.y)) for d in curve.dots]
        if len(at) > 1:
            line = " ".join(f"{px:.1f},{py:.1f}" for px, py in at)
            dashed = ' class="dashed"' if i >= COLORS else ""
            yield f'<polyline points="{line}" fill="none" stroke="{_color(i)}" stroke-width="1.6"{dashed}/>'
        for dot, (px, py) in zip(curve.dots, at, strict=True):
            said = ": ".join(filter(None, (curve.name, dot.name, f"{short(dot.x)}, {short(dot.y)}")))
            if dot.chosen:
                yield f'<circle class="ring" cx="{px:.1f}" cy="{py:.1f}" r="7"/>'
            place = f'cx="{px:.1f}" cy="{py:.1f}" r="3.6"'
            yield f'<circle {place} fill="{_color(i)}"><title>{escape(said)}</title></circle>'


def _names(curves: Sequence[Curve], across: Scale, up: Scale) -> Iterator[str]:
    """Yield the names of points, the chosen ones first, where they hide neither a point nor another name.

    Of more than two curves with the same names each name is shown once.
    """
    seen = {""}
    dots = sorted((d for curve in curves for d in curve.dots), key=lambda d: not d.chosen)
    taken = [(_x(across, d.x) - 4, _y(up, d.y) - 4, _x(across, d.x) + 4, _y(up, d.y) + 4) for d in dots]
    for dot in dots:
        px, py, width = _x(across, dot.x), _y(up, dot.y), LETTER * len(dot.name)
        for left, top in ((9, -6), (-9 - width, -6), (-width / 2, -20), (-width / 2, 8), (8, -18), (8, 6),
                          (-8 - width, -18), (-8 - width, 6)):  # fmt: skip
            left += 3 * dot.chosen * ((left > 0) - (left < -width / 2))  # clear of its ring
            box = (px + left, py + top, px + left + width, py + top + LINE)
            inside = box[0] > LEFT - 2 and box[2] < WIDTH and box[1] > 0 and box[3] < HEIGHT - BOTTOM + 2
            if dot.name not in seen and inside and not any(_meet(box, other) for other in taken):
                taken.append(box)
                seen |= {dot.name} if len(curves) > 2 else set()
                weight = ' font-weight="600"' if dot.chosen else ""
                at = f'x="{box[0]:.1f}" y="{box[1] + 10:.1f}"'
                yield f'<text class="halo" {at}{weight}>{escape(dot.name)}</text>'
                break


def _meet(a: tuple[float, ...], b: tuple[float, ...]) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


def _x(scale: Scale, value: float) -> float:
    return LEFT + scale.at(value) * (WIDTH - LEFT - RIGHT)


def _y(scale: Scale, value: float) -> float:
    return HEIGHT - BOTTOM - scale.at(value) * (HEIGHT - BOTTOM - TOP)


def _color(i: int) -> str:
    return f"var(--c{i % COLORS})"
