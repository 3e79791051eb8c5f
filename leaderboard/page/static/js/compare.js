"use strict";
/* One scene: truth and two methods under a slider, error maps, a time scrubber, a crop of what moves, curves. */
Spike4DGS.compare = (() => {
  const { el, byId, fill, format, heading } = Spike4DGS.dom;
  const COLORS = ["#4269d0", "#d97a00"];
  let drawing = 0;

  async function draw(page, state, view, change) {
    const turn = ++drawing;
    const { board } = view;
    const number = page.boards.indexOf(board);
    const [pictures, scores] = await Promise.all([
      Spike4DGS.load(`pictures-${number}`), view.metric ? Spike4DGS.load(`scores-${number}-${view.metric}`) : null]);
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
        picture && el("label", { class: "check" }, el("input", { type: "checkbox", name: "crop", checked: state.crop,
          onchange: (e) => change({ crop: e.target.checked }) }), "Crop what moves")),
      sceneFacts(board.scenes[s]),
      picture ? panes(context, text, figure) : el("p", { class: "small" }, page.hint),
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

  function panes(context, text, figure) {
    const { board, a, b, picture, k, names, state, change } = context;
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
        el("label", {}, el("span", {}, "Time: ", el("output", { id: "at" })),
          el("input", { type: "range", name: "k", min: "0", max: String(names.length - 1), value: String(k),
            oninput: (e) => update(context, Number(e.target.value), text, figure),
            onchange: (e) => change({ k: Number(e.target.value) }, true) }))),
      el("div", { class: "grid" },
        pane("pane-truth", "Truth", "Truth"),
        pane("pane-images", `${nameA} | ${nameB}`, `Images of ${nameA} and ${nameB}`),
        pane("pane-errors", "Absolute error, black 0 to white 0.3", `Error maps of ${nameA} and ${nameB}`)));
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
    const at = picture ? `${picture.ms[k].toFixed(2)} ms` : names[k];
    if (byId("at")) byId("at").textContent = `${at} (image ${k + 1} of ${names.length})`;
    const image = scores.images[s].indexOf(names[k]);
    const one = (row) => {
      const values = scores.values[scores.rows.indexOf(row)]?.[s];
      return values && image >= 0 ? [values[image]].flat().reduce((x, y) => x + y, 0) / [values[image]].flat().length : null;
    };
    fill(text, `${heading(metric)} at ${at}: `, el("strong", {}, board.rows[a].name), ` ${format(metric, one(a))}, `,
      el("strong", {}, board.rows[b].name), ` ${format(metric, one(b))}`);
    const lines = scores.rows.map((row, r) => ({ name: board.rows[row].name, color: row === a ? COLORS[0] : row === b ? COLORS[1] : null,
      values: scores.values[r][s].map((v) => [v].flat().reduce((x, y) => x + y, 0) / [v].flat().length) }));
    Spike4DGS.plots.curves(figure, lines, metric, image >= 0 ? image : null, scores.images[s]);
  }

  function show(picture, crop, a, b, k) {
    const path = (row, kind) => `${picture.folder}/${row}/${k}${kind}.webp`;
    const put = (pane, below, over) => {
      const [first, second] = byId(pane).querySelectorAll("img");
      first.src = below;
      if (second) second.src = over;
      frame(byId(pane).querySelector(".frame"), picture, crop);
    };
    put("pane-truth", path("truth", ""));
    put("pane-images", path(b, ""), path(a, ""));
    put("pane-errors", path(b, "-error"), path(a, "-error"));
  }

  /* Scale the images so that the crop, or all, fills the frame. The slider cuts the frame, not the images. */
  function frame(node, picture, crop) {
    const [x, y, w, h] = crop ?? [0, 0, picture.width, picture.height];
    node.style.aspectRatio = `${w} / ${h}`;
    const percent = { left: -x / w, top: -y / h, width: picture.width / w, height: picture.height / h };
    for (const img of node.querySelectorAll("img")) {
      for (const [key, value] of Object.entries(percent)) img.style[key] = `${100 * value}%`;
    }
  }

  return { draw };
})();
