"""The style sheet of every report."""

from __future__ import annotations

COLORS = 8  # of curves, --c0 to --c7; a further curve starts again, with a dashed line

# The first colours are Okabe and Ito's, which people who are colour-blind tell apart; lighter ones on a dark ground.
STYLE = """
:root {
  color-scheme: light dark; font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Noto Sans", sans-serif;
  --ground: #fff; --panel: #f4f5f7; --line: #d5d8de; --text: #1b1f27; --soft: #59606d; --link: #2454c4;
  --good: #0b6b3a; --bad: #b3261e;
  --c0: #0072b2; --c1: #c75000; --c2: #007a5a; --c3: #a64d85; --c4: #8a6d00; --c5: #3f6f8c;
  --c6: #6a45b8; --c7: #b3123f;
}
@media (prefers-color-scheme: dark) {
  :root {
    --ground: #14171c; --panel: #1d2128; --line: #363c47; --text: #e6e8ec; --soft: #a3aab7; --link: #8ab4ff;
    --good: #63d297; --bad: #ff8a80;
    --c0: #56b4e9; --c1: #ff9d4d; --c2: #3ecf9f; --c3: #e29bc6; --c4: #f0e442; --c5: #a9cbe0;
    --c6: #b9a3ff; --c7: #ff8fa3;
  }
}
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 76rem; padding: 0 1rem 3rem; background: var(--ground); color: var(--text); }
body { overflow-wrap: break-word; }
h1 { font-size: 1.5rem; line-height: 1.25; margin: 1.2rem 0 .3rem; }
h2 { font-size: 1.2rem; margin: 2.2rem 0 .4rem; padding-top: .7rem; border-top: 1px solid var(--line); }
h3 { font-size: 1.02rem; margin: 1.4rem 0 .3rem; }
p { margin: .3rem 0 .6rem; max-width: 52rem; } ul { margin: .3rem 0 .6rem; padding-left: 1.2rem; }
a { color: var(--link); } :focus-visible { outline: 3px solid var(--link); outline-offset: 1px; }
code { overflow-wrap: anywhere; font-size: .92em; }
.soft, figcaption, .unit { color: var(--soft); font-size: .88rem; } .good { color: var(--good); }
.bad { color: var(--bad); overflow-wrap: anywhere; }
nav ul { display: flex; flex-wrap: wrap; gap: .1rem 1rem; list-style: none; padding: 0; }
.scroll { overflow-x: auto; margin: .5rem 0 .9rem; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: .9rem; }
th, td { padding: .25rem .8rem .25rem 0; text-align: left; border-bottom: 1px solid var(--line); vertical-align: top; }
thead th { vertical-align: bottom; color: var(--soft); font-weight: 600; }
.number { text-align: right; white-space: nowrap; } thead .number { white-space: normal; }
.wide table { min-width: 64rem; } .wide td { max-width: 19rem; } .wide td:first-child { white-space: nowrap; }
tr.marked > * { font-weight: 600; background: var(--panel); }
.facts th { white-space: nowrap; } .facts td { overflow-wrap: anywhere; }
.grid { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 26rem), 1fr)); gap: 1rem 1.5rem; }
figure { margin: 0; min-width: 0; max-width: 38rem; }
figure svg, figure img { display: block; width: 100%; height: auto; }
.legend { display: flex; flex-wrap: wrap; gap: .1rem .9rem; list-style: none; margin: 0; padding: 0; }
.legend { font-size: .85rem; }
.swatch { display: inline-block; width: .8rem; height: .8rem; border-radius: 50%; margin-right: .3rem; }
svg text { fill: var(--text); font-size: 11px; } svg .axis text, svg .title { fill: var(--soft); }
svg .grid-line { stroke: var(--line); stroke-width: 1; } svg .ring { fill: none; stroke: var(--text); stroke-width: 2; }
svg .halo { paint-order: stroke; stroke: var(--ground); stroke-width: 3px; stroke-linejoin: round; }
svg .dashed { stroke-dasharray: 5 4; }
summary { cursor: pointer; color: var(--link); }
@media (max-width: 40rem) {
  .facts th, .facts td { display: block; border: 0; padding: 0; } .facts td { padding-bottom: .5rem; }
  .facts { width: 100%; }
}
"""
