"use strict";
/* Quality against each cost. Families are coloured, rows that the filters hide and entries without a rank are gray. */
Spike4DGS.plots = (() => {
  const { el, byId, fill, format, heading } = Spike4DGS.dom;
  const { COSTS, isBelow } = Spike4DGS.model;
  const COLOR_BY = { motion: "motion", images: "images from spikes", initialization: "initialization", supervision: "supervision" };
  const COLORS = ["#4269d0", "#d97a00", "#c2304a", "#1b8a7a", "#8c5fd3", "#6a7f10", "#b0568a", "#7a5540"];
  const WIDTH = 420;
  const HEIGHT = 300;
  const MARGINS = { left: 48, right: 16, top: 20, bottom: 34 };
  const LETTER = 6.6; // pixels, of the plots' 12px text
  const MOST_NAMED = 40; // of the points of a plot
  const FAR = 0.75; // a gap of so much of the range of those above it makes those below it a floor, which is on the edge
  const FAR_FACTOR = 10; // of a cost, if the gap is also as large as this...
  const FAR_DB = 3; // ... or as this, of a quality in dB

  /* Draw the plots; they take a while, so each is a task of its own, as long as `current` holds. */
  async function draw(page, state, view, change, current) {
    const part = state.color in COLOR_BY ? state.color : "motion";
    const metric = page.index.get(view.metric);
    const families = [...new Set(view.board.rows.map((row) => row.parts[part]))].sort();
    const color = (item) => COLORS[families.indexOf(item.row.parts[part]) % COLORS.length];
    const items = [...view.shown, ...view.hidden].filter((item) => item.values[view.metric] !== null);
    const range = limits(items.map((item) => item.values[view.metric]), metric.higher, metric.unit === "dB" ? FAR_DB : 0);
    const legend = el("ul", { class: "legend" }, families.map((name, i) => {
      const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
      swatch.style.background = COLORS[i % COLORS.length];
      return el("li", {}, swatch, name);
    }));
    const select = el("select", { name: "color", onchange: (e) => change({ color: e.target.value }) },
      Object.entries(COLOR_BY).map(([v, text]) => el("option", { value: v, selected: v === part }, text)));
    const grid = el("div", { class: "grid" });
    const edge = el("p", { class: "small" });
    fill(byId("plots"), el("h2", {}, `${metric.title} against cost`),
      el("div", { class: "fields" }, el("label", {}, el("span", {}, "Colour by"), select), legend),
      grid, edge);
    const far = new Set();
    for (const [n, id] of COSTS.entries()) {
      if (n) await new Promise((resolve) => setTimeout(resolve));
      if (!current()) return;
      grid.append(figure(page.index.get(id), metric, items, range, color, far, (item) => isBelow(view.board, item.row)));
    }
    const told = [...far].map((item) => `${item.row.name} (${format(metric, item.values[view.metric])}, fit ${seconds(item.values.fit_seconds)})`);
    if (told.length) edge.textContent = `On the edge, beyond an axis (▼ ◀ ▶): ${told.join(", ")}.`;
  }

  const seconds = (value) => (value === null ? "–" : value >= 1 ? `${value.toFixed(0)} s` : `${value.toPrecision(1)} s`);

  /* Return the axis: without values that lie far off on one side, which would press all others together. That is the
     worse side of quality, and the cheap side of a cost. `least` is the smallest gap that is far. */
  function limits(values, higher, least) {
    const good = (v) => (higher ? v : -v);
    const sorted = values.map(good).sort(d3.ascending);
    let first = 0;
    for (let k = 1; 2 * k < sorted.length; k++) {
      if (sorted[k] - sorted[k - 1] >= Math.max(least, FAR * (sorted.at(-1) - sorted[k]), 1e-9)) first = k;
    }
    const margin = 0.06 * (sorted.at(-1) - sorted[first] || 1);
    const ends = [sorted[first] - margin, sorted.at(-1) + margin].map(good).sort(d3.ascending);
    return { ends, clamp: (v) => Math.min(Math.max(v, ends[0]), ends[1]) };
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
    return ticks.length < 3 ? d3.ticks(...domain, 6) : ticks;
  }

  /* Return the names that have room beside their points, with their places: clear of other names, of the points and of
     the plot's edges. `at` gives a point's pixels; the first points are the first to get room. */
  function labelled(points, at, every) {
    const dots = every.map(at);
    const boxes = [];
    const found = [];
    for (const p of points.slice(0, MOST_NAMED)) {
      const [x, y] = at(p);
      const w = LETTER * p.name.length;
      for (const [dx, dy, anchor] of [[0, -12, "middle"], [9, 0, "start"], [-9, 0, "end"], [0, 13, "middle"], [6, -11, "start"], [-6, -11, "end"]]) {
        const left = x + dx - (anchor === "middle" ? w / 2 : anchor === "end" ? w : 0);
        const box = [left, y + dy - 6, left + w, y + dy + 6];
        const clear = box[0] >= MARGINS.left + 1 && box[2] <= WIDTH - 2 && box[1] >= 2 && box[3] <= HEIGHT - MARGINS.bottom &&
          boxes.every((b) => box[0] >= b[2] || box[2] <= b[0] || box[1] >= b[3] || box[3] <= b[1]) &&
          dots.every(([u, v]) => u + 4 <= box[0] || u - 4 >= box[2] || v + 4 <= box[1] || v - 4 >= box[3]);
        if (!clear) continue;
        boxes.push(box);
        found.push({ p, dx, dy, anchor });
        break;
      }
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

  function figure(cost, metric, items, range, color, far, below) {
    const points = items.filter((item) => item.values[cost.id] > 0).map((item) => ({
      item, name: item.row.name, cost: item.values[cost.id], value: item.values[metric.id],
      y: range.clamp(item.values[metric.id]), why: item.why ? "hidden by filters" : below(item) ? "not ranked" : "" }));
    const without = items.length - points.length;
    const title = `${metric.title} against ${cost.title}`;
    const caption = el("figcaption", {}, heading(cost), without ? el("span", { class: "note" }, ` ${without} without a positive value`) : null);
    if (!points.length) return el("figure", {}, caption, el("p", { class: "small" }, "No values."));
    // Costs are better where they are low, images/s where they are high: there a value may lie far off.
    const span = limits(points.map((p) => Math.log(p.cost)), !cost.higher, Math.log(FAR_FACTOR));
    const domain = span.ends.map(Math.exp);
    for (const p of points) {
      p.x = Math.min(Math.max(p.cost, domain[0]), domain[1]);
      p.mark = p.x < p.cost ? "▶" : p.x > p.cost ? "◀" : p.y !== p.value ? "▼" : "";
      if (p.mark && !p.item.why) far.add(p.item);
    }
    const shown = points.filter((p) => !p.why);
    const best = front(shown, metric.higher, !cost.higher);
    const [bottom, top] = metric.higher ? range.ends : [...range.ends].reverse();
    const toX = d3.scaleLog(domain, [MARGINS.left, WIDTH - MARGINS.right]);
    const toY = d3.scaleLinear([bottom, top], [HEIGHT - MARGINS.bottom, MARGINS.top]);
    const names = labelled([...[...best].reverse(), ...shown.filter((p) => !best.includes(p))], (p) => [toX(p.x), toY(p.y)], points);
    const tipText = (p) => `${p.name}\n${metric.title} ${p.value.toFixed(metric.digits)}\n${cost.title} ${p.cost.toFixed(cost.digits)}${p.why && `\n${p.why}`}`;
    const plot = Plot.plot({
      width: WIDTH, height: HEIGHT, marginLeft: MARGINS.left, marginRight: MARGINS.right, marginTop: MARGINS.top, marginBottom: MARGINS.bottom, style: { background: "none", fontSize: "12px" },
      ariaLabel: title, ariaDescription: "The table has the same values.",
      x: { type: "log", domain, ticks: ticksOf(domain), tickFormat: (v) => d3.format("~g")(v), label: null, grid: true },
      y: { domain: [bottom, top], label: heading(metric), grid: true, nice: false, ticks: 5 },
      marks: [
        Plot.line(best, { x: "x", y: "y", curve: cost.higher ? "step-before" : "step-after", stroke: "currentColor", strokeOpacity: 0.35 }),
        Plot.dot(points.filter((p) => p.why), { x: "x", y: "y", r: 4, fill: "#999", fillOpacity: 0.6 }),
        Plot.dot(shown.filter((p) => !p.mark), { x: "x", y: "y", r: 5, fill: (p) => color(p.item), stroke: "var(--ground)" }),
        Plot.text(shown.filter((p) => p.mark), { x: "x", y: "y", text: "mark", fill: (p) => color(p.item) }),
        ...names.map(({ p, dx, dy, anchor }) => Plot.text([p], { x: "x", y: "y", text: "name", dx, dy, textAnchor: anchor,
          fill: "currentColor", stroke: "var(--ground)", strokeWidth: 3 })),
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
      width: Math.max(280, Math.min(1200, byId("scenes").clientWidth)), height: 240, marginLeft: 48, marginBottom: 40, style: { background: "none", fontSize: "12px" },
      ariaLabel: `${metric.title} of each image`, ariaDescription: "The scores of both methods at the shown image are in the text.",
      x: { label: "image", labelAnchor: "center", labelArrow: "none", ticks: d3.range(0, names.length, Math.ceil(names.length / 10)), tickFormat: "d" }, y: { label: heading(metric), grid: true, zero: false },
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

  return { draw, curves };
})();
