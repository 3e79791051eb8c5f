"use strict";
/* One scene: truth and two methods under a slider, error maps, a time scrubber, a crop of what moves, curves.
   The images are those of runs, or of one target, from the entries' sheets. */
Spike4DGS.compare = (() => {
  const { el, byId, fill, format, heading } = Spike4DGS.dom;
  const COLORS = ["#4269d0", "#d97a00"];
  let drawing = 0;

  async function draw(page, state, view, change) {
    const turn = ++drawing;
    const { board } = view;
    const number = page.boards.indexOf(board);
    const [pictures, scores] = await Promise.all([
      Spike4DGS.load(`pictures-${number}`), board.scored.length ? Spike4DGS.load(`scores-${number}-${view.metric}`) : null]);
    if (turn !== drawing) return;
    if (!scores) return void fill(byId("scenes"));
    const s = Math.max(0, board.scenes.findIndex((scene) => scene.id === state.scene));
    const picture = pictures[s];
    const pool = candidates(view, picture, scores);
    if (!pool.length) return void fill(byId("scenes"), el("h2", {}, "Scene by scene"), el("p", {}, "No row has scores image by image."));
    const pick = (name, other) => pool.find((i) => board.rows[i].name === name) ?? pool.find((i) => i !== other) ?? pool[0];
    const a = pick(state.a, -1);
    const b = pick(state.b, a);
    const names = picture ? picture.names : scores.images[s];
    const k = Math.min(Math.max(state.k ?? Math.floor(names.length / 2), 0), names.length - 1);
    const context = { page, state, view, board, s, a, b, k, names, picture, scores, change };
    const choice = (name, title, chosen, options) => el("label", {}, el("span", {}, title),
      el("select", { name, onchange: (e) => change({ [name]: e.target.value }) },
        options.map((text) => el("option", { value: text, selected: text === chosen }, text))));
    const rowNames = pool.map((i) => board.rows[i].name);
    const focused = byId("scenes").contains(document.activeElement) ? document.activeElement.name : null;
    const text = el("p", { id: "scene-scores", role: "status" });
    const figure = el("div", { class: "curves" });
    fill(byId("scenes"), el("h2", {}, "Scene by scene"),
      el("div", { class: "fields" },
        choice("scene", "Scene", board.scenes[s].id, board.scenes.map((scene) => scene.id)),
        choice("a", "Method A", board.rows[a].name, rowNames), choice("b", "Method B", board.rows[b].name, rowNames),
        picture && scaleChoice(context),
        picture && el("label", { class: "check" }, el("input", { type: "checkbox", name: "crop", checked: state.crop,
          onchange: (e) => change({ crop: e.target.checked }) }), "Crop what moves")),
      sceneFacts(board.scenes[s]),
      picture ? panes(context, text, figure) : el("p", { class: "small" }, page.hint),
      picture?.sheets && el("p", { class: "small" }, page.one),
      text, figure);
    update(context, k, text, figure);
    byId("scenes").querySelector(`[name="${focused}"]`)?.focus();
  }

  /* Return the rows to choose from: those with images where there are some, else those with scores, best first. */
  function candidates(view, picture, scores) {
    const order = [...view.shown, ...view.hidden].map((item) => item.index);
    const has = new Set(picture ? picture.rows : scores.rows);
    return order.filter((i) => has.has(i));
  }

  function sceneFacts(scene) {
    const ceiling = scene.ceiling ? ` The truth's own noise allows ${scene.ceiling.toFixed(1)} dB at most.` : "";
    return el("p", { class: "small" }, `Revision ${scene.revision.slice(0, 12)}.${ceiling}`);
  }

  /* The error of the brightest colour: the one chosen, or the wider of what both methods start with. */
  function scaleOf({ page, state, picture, a, b }) {
    const own = page.errors.scales.find((scale) => nameOf(page, scale) === state.e);
    return own ?? Math.max(picture.scales[a], picture.scales[b]);
  }

  const nameOf = (page, scale) => String(Math.round(page.errors.max / scale));

  function scaleChoice(context) {
    const { page, state, change } = context;
    const names = page.errors.scales.map((scale) => [nameOf(page, scale), `×${nameOf(page, scale)}: 0 to ${scale}`]);
    return el("label", {}, el("span", {}, "Scale of errors"), el("select", { name: "e", onchange: (e) => change({ e: e.target.value }) },
      [["", "as both need"], ...names].map(([v, text]) => el("option", { value: v, selected: v === state.e }, text))));
  }

  /* Return the address of a filter that colours error levels on a scale: level v stands for max (v / 255)^2. */
  function colours(page, scale) {
    const id = `errors-${nameOf(page, scale)}`;
    if (!byId(id)) {
      const svg = (tag, attributes, ...children) => {
        const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
        for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
        node.append(...children);
        return node;
      };
      const index = (v) => Math.round(255 * Math.min(1, (page.errors.max * (v / 255) ** 2) / scale));
      const table = (c) => Array.from({ length: 256 }, (_, v) => page.errors.colors[index(v)][c] / 255).join(" ");
      const parts = ["R", "G", "B"].map((name, c) => svg(`feFunc${name}`, { type: "table", tableValues: table(c) }));
      document.body.append(svg("svg", { width: 0, height: 0, class: "hidden-text", "aria-hidden": "true" },
        svg("filter", { id, "color-interpolation-filters": "sRGB" }, svg("feComponentTransfer", {}, ...parts))));
    }
    return `url(#${id})`;
  }

  /* What the colours of the error maps mean. */
  function scaleBar(page, scale) {
    const bar = el("span", { class: "scale", "aria-hidden": "true" });
    const stops = page.errors.colors.filter((_, i) => i % 15 === 0).map((c) => `rgb(${c.join(" ")})`);
    bar.style.backgroundImage = `linear-gradient(to right, ${stops.join(", ")})`;
    return [`Absolute error ×${nameOf(page, scale)}: 0 `, bar, ` ${scale}, where 1 is white`];
  }

  function panes(context, text, figure) {
    const { page, board, a, b, k, names, state, change } = context;
    const scale = scaleOf(context);
    const nameA = board.rows[a].name;
    const nameB = board.rows[b].name;
    const split = Math.min(Math.max(state.split ?? 50, 0), 100);
    const pane = (id, title, alt) => el("figure", { class: "pane", id }, el("div", { class: "frame" },
      el("img", { alt, draggable: "false" }),
      id !== "pane-truth" && [el("div", { class: "over" }, el("img", { alt: "", draggable: "false" })),
        el("div", { class: "bar", "aria-hidden": "true" })]), el("figcaption", {}, title));
    const node = el("div", { class: "compare" },
      el("div", { class: "sliders" },
        el("label", {}, el("span", {}, `Slider: ${nameA} on the left, ${nameB} on the right`),
          el("input", { type: "range", name: "split", min: "0", max: "100", value: String(split),
            oninput: (e) => place(node, Number(e.target.value)), onchange: (e) => change({ split: Number(e.target.value) }, true) })),
        names.length > 1 && el("label", {}, el("span", {}, "Time: ", el("output", { id: "at" })),
          el("input", { type: "range", name: "k", "aria-label": "Time", min: "0", max: String(names.length - 1), value: String(k),
            oninput: (e) => update(context, Number(e.target.value), text, figure),
            onchange: (e) => change({ k: Number(e.target.value) }, true) }))),
      el("div", { class: "grid" },
        pane("pane-truth", "Truth", "Truth"),
        pane("pane-images", `${nameA} | ${nameB}`, `Images of ${nameA} and ${nameB}`),
        pane("pane-errors", scaleBar(page, scale), `Error maps of ${nameA} and ${nameB}`)));
    for (const img of node.querySelectorAll("#pane-errors img")) img.style.filter = colours(page, scale);
    place(node, split);
    return node;
  }

  /* Method A is seen left of the slider, B right of it. */
  function place(node, percent) {
    for (const over of node.querySelectorAll(".over")) over.style.clipPath = `inset(0 ${100 - percent}% 0 0)`;
    for (const bar of node.querySelectorAll(".bar")) bar.style.left = `${percent}%`;
  }

  function update(context, k, text, figure) {
    const { page, view, board, s, a, b, names, picture, scores, state } = context;
    const metric = page.index.get(view.metric);
    if (picture) show(picture, state.crop ? picture.crops[k] : null, a, b, k);
    const at = picture?.ms ? `${picture.ms[k].toFixed(2)} ms` : names[k];
    if (byId("at")) byId("at").textContent = `${at} (image ${k + 1} of ${names.length})`;
    const image = scores.images[s].indexOf(names[k]);
    const one = (row) => {
      const values = scores.values[scores.rows.indexOf(row)]?.[s];
      return values && image >= 0 ? [values[image]].flat().reduce((x, y) => x + y, 0) / [values[image]].flat().length : null;
    };
    const lines = scores.rows.map((row, r) => ({ name: board.rows[row].name, color: row === a ? COLORS[0] : row === b ? COLORS[1] : null,
      values: scores.values[r][s].map((v) => [v].flat().reduce((x, y) => x + y, 0) / [v].flat().length) }));
    fill(text, `${heading(metric)} at ${at}: `, named(board.rows[a], COLORS[0]), ` ${format(metric, one(a))}, `, named(board.rows[b], COLORS[1]), ` ${format(metric, one(b))}`,
      lines.every((line) => line.color) ? null : ". Gray: the other methods.");
    Spike4DGS.plots.curves(figure, lines, metric, image >= 0 ? image : null, scores.images[s]);
  }
  function named(row, color) {
    const swatch = el("span", { class: "swatch", "aria-hidden": "true" });
    swatch.style.background = color;
    return [swatch, el("strong", {}, row.name)];
  }

  const KINDS = ["truth", "render", "error"]; // in the order of a sheet's columns

  /* Return where an image lies: a file, its size, and the image's corner in it. */
  function source({ folder, sheets, width, height }, kind, row, k) {
    if (sheets) return { ...sheets[row], left: KINDS.indexOf(kind) * width };
    const name = kind === "truth" ? `truth/${k}` : `${row}/${k}${kind === "error" ? "-error" : ""}`;
    return { file: `${folder}/${name}.webp`, width, height, left: 0, top: 0 };
  }

  function show(picture, crop, a, b, k) {
    const put = (pane, kind, ...rows) => {
      const images = byId(pane).querySelectorAll("img");
      rows.forEach((row, i) => fit(images[i], picture, source(picture, kind, row, k), crop));
    };
    put("pane-truth", "truth", a);
    put("pane-images", "render", b, a);
    put("pane-errors", "error", b, a);
  }

  /* Scale an image so that the crop, or all, fills its frame. The slider cuts the frame, not the images. */
  function fit(img, picture, { file, left, top, width, height }, crop) {
    const [x, y, w, h] = crop ?? [0, 0, picture.width, picture.height];
    img.closest(".frame").style.aspectRatio = `${w} / ${h}`;
    img.src = file;
    const percent = { left: -(left + x) / w, top: -(top + y) / h, width: width / w, height: height / h };
    for (const [key, value] of Object.entries(percent)) img.style[key] = `${100 * value}%`;
  }

  return { draw };
})();
