"use strict";
/* Quality against each cost. Families are coloured, rows that the filters hide are gray. */
Spike4DGS.plots = (() => {
  const { el, byId, fill, heading } = Spike4DGS.dom;
  const { COSTS, facet, mean } = Spike4DGS.model;
  const COLOR_BY = { motion: "motion", images: "images from spikes", initialization: "initialization", supervision: "supervision" };
  const COLORS = ["#4269d0", "#d97a00", "#c2304a", "#1b8a7a", "#8c5fd3", "#6a7f10", "#b0568a", "#7a5540"];
  const LARGEST_GAP = 3; // interquartile ranges below the lower quartile: such a floor is put on the edge

  function draw(page, state, view, change) {
    const part = state.color in COLOR_BY ? state.color : "motion";
    const metric = page.index.get(view.metric);
    const families = [...new Set(view.board.rows.map((row) => row.parts[part]))].sort();
    const color = (item) => COLORS[families.indexOf(item.row.parts[part]) % COLORS.length];
    const items = [...view.shown, ...view.hidden].filter((item) => item.values[view.metric] !== null);
    const range = limits(items.map((item) => item.values[view.metric]), metric.higher);
    const legend = el("ul", { class: "legend" }, families.map((name, i) => {
      const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
      swatch.style.background = COLORS[i % COLORS.length];
      return el("li", {}, swatch, name);
    }));
    const select = el("select", { name: "color", onchange: (e) => change({ color: e.target.value }) },
      Object.entries(COLOR_BY).map(([v, text]) => el("option", { value: v, selected: v === part }, text)));
    fill(byId("plots"), el("h2", {}, `${metric.title} against cost`),
      el("div", { class: "fields" }, el("label", {}, el("span", {}, "Colour by"), select), legend),
      el("div", { class: "grid" }, COSTS.map((id) => figure(page.index.get(id), metric, items, range, color))),
      range.out.length ? el("p", { class: "small" }, `On the edge, beyond the axis (▼): ${range.out.map((v) => v.toFixed(metric.digits)).join(", ")}.`) : null);
  }

  /* Return the axis: without values that lie far off on the worse side, which would press all others together. */
  function limits(values, higher) {
    const good = (v) => (higher ? v : -v);
    const sorted = values.map(good).sort(d3.ascending);
    const [low, high] = [d3.quantile(sorted, 0.25), d3.quantile(sorted, 0.75)];
    const floor = low - LARGEST_GAP * Math.max(high - low, 1e-9);
    const inside = sorted.filter((v) => v >= floor);
    const margin = 0.06 * (inside.at(-1) - inside[0] || 1);
    const ends = [inside[0] - margin, inside.at(-1) + margin].map(good).sort(d3.ascending);
    return { ends, out: sorted.filter((v) => v < floor).map(good), clamp: (v) => Math.min(Math.max(v, ends[0]), ends[1]) };
  }

  /* Return 1, 2 and 5 of each decade within a domain; only decades where those are many. */
  function logTicks([low, high]) {
    const decades = d3.range(Math.floor(Math.log10(low)), Math.ceil(Math.log10(high)) + 1);
    const steps = Math.log10(high / low) > 2.2 ? [1] : [1, 2, 5];
    return decades.flatMap((e) => steps.map((s) => s * 10 ** e)).filter((v) => v >= low && v <= high);
  }

  /* Return 1, 2 and 5 of the decades, or even steps where a domain has less than three of them. */
  function ticksOf(domain) {
    const ticks = logTicks(domain);
    return ticks.length < 3 ? d3.ticks(...domain, 4) : ticks;
  }

  /* Return the points whose names do not lie on those of others, best first. */
  function labelled(points, domain, ends) {
    const found = [];
    const x = d3.scaleLog(domain, [0, 1]);
    const y = d3.scaleLinear(ends, [0, 1]);
    for (const p of points) {
      if (found.every((q) => Math.abs(x(p.x) - x(q.x)) > 0.28 || Math.abs(y(p.y) - y(q.y)) > 0.07)) found.push(p);
    }
    return found;
  }

  function front(points, higherIsBetter, cheapIsLow) {
    const sorted = d3.sort(points, (p) => (cheapIsLow ? p.x : -p.x), (p) => (higherIsBetter ? -p.value : p.value));
    const found = [];
    for (const p of sorted) {
      const last = found.at(-1);
      if (!last || (higherIsBetter ? p.value > last.value : p.value < last.value)) found.push(p);
    }
    return found;
  }

  function figure(cost, metric, items, range, color) {
    const points = items.filter((item) => item.values[cost.id] > 0).map((item) => ({
      item, name: item.row.name, x: item.values[cost.id], value: item.values[metric.id],
      y: range.clamp(item.values[metric.id]), hidden: Boolean(item.why) }));
    const without = items.length - points.length;
    const title = `${metric.title} against ${cost.title}`;
    const caption = el("figcaption", {}, heading(cost), without ? el("span", { class: "note" }, ` ${without} without a positive value`) : null);
    if (!points.length) return el("figure", {}, caption, el("p", { class: "small" }, "No values."));
    const [low, high] = d3.extent(points, (p) => p.x);
    const domain = [low / 1.25, high * 1.25];
    const best = front(points.filter((p) => !p.hidden), metric.higher, !cost.higher);
    const names = labelled([...best].reverse(), domain, range.ends);
    const isRight = (p) => Math.log(p.x / low) > 0.75 * Math.log(high / low);
    const tipText = (p) => `${p.name}\n${metric.title} ${p.value.toFixed(metric.digits)}\n${cost.title} ${p.x.toFixed(cost.digits)}${p.hidden ? "\nhidden by filters" : ""}`;
    const plot = Plot.plot({
      width: 420, height: 300, marginLeft: 48, marginRight: 16, marginBottom: 34, style: { background: "none", fontSize: "12px" },
      ariaLabel: title, ariaDescription: "The table has the same values.",
      x: { type: "log", domain, ticks: ticksOf(domain), tickFormat: (v) => d3.format("~g")(v), label: null, grid: true },
      y: { domain: metric.higher ? range.ends : [...range.ends].reverse(), label: heading(metric), grid: true, nice: false, ticks: 5 },
      marks: [
        Plot.line(best, { x: "x", y: "y", curve: cost.higher ? "step-before" : "step-after", stroke: "currentColor", strokeOpacity: 0.35 }),
        Plot.dot(points.filter((p) => p.hidden), { x: "x", y: "y", r: 4, fill: "#999", fillOpacity: 0.6 }),
        Plot.dot(points.filter((p) => !p.hidden && p.y === p.value), { x: "x", y: "y", r: 5, fill: (p) => color(p.item), stroke: "var(--ground)" }),
        Plot.text(points.filter((p) => !p.hidden && p.y !== p.value), { x: "x", y: "y", text: () => "▼", fill: (p) => color(p.item) }),
        ...[true, false].map((right) => Plot.text(names.filter((p) => isRight(p) === right), { x: "x", y: "y", text: "name",
          dy: -11, dx: right ? 6 : 0, textAnchor: right ? "end" : "middle", fill: "currentColor", stroke: "var(--ground)", strokeWidth: 3 })),
        Plot.tip(points, Plot.pointer({ x: "x", y: "y", title: tipText, fill: "var(--ground)" })),
      ],
    });
    plot.setAttribute("role", "img");
    return el("figure", {}, caption, plot);
  }

  /* Scores image by image: two methods in colour, the others gray, the shown image marked. */
  function curves(node, lines, metric, at, names) {
    const series = lines.flatMap((line) => line.values.map((value, i) => ({ i, value, ...line })));
    const plot = Plot.plot({
      width: Math.min(640, window.innerWidth - 28), height: 220, marginLeft: 48, style: { background: "none", fontSize: "12px" },
      ariaLabel: `${metric.title} of each image`, ariaDescription: "The scores of both methods at the shown image are in the text.",
      x: { label: "image", ticks: d3.range(0, names.length, Math.ceil(names.length / 10)), tickFormat: "d" }, y: { label: heading(metric), grid: true, zero: false },
      marks: [
        at === null ? null : Plot.ruleX([at], { stroke: "currentColor", strokeOpacity: 0.5, strokeDasharray: "3,3" }),
        Plot.line(series.filter((d) => !d.color), { x: "i", y: "value", z: "name", stroke: "#999", strokeOpacity: 0.5, strokeWidth: 1 }),
        Plot.line(series.filter((d) => d.color), { x: "i", y: "value", z: "name", stroke: (d) => d.color, strokeWidth: 2, marker: "dot" }),
        Plot.tip(series, Plot.pointer({ x: "i", y: "value", title: (d) => `${d.name}, ${names[d.i]}\n${d.value.toFixed(metric.digits)}`, fill: "var(--ground)" })),
      ],
    });
    plot.setAttribute("role", "img");
    fill(node, plot);
  }

  return { draw, curves, COLORS, logTicks };
})();
