"use strict";
/* Questions, tabs and filters. They show the state and change it; `app` draws what follows. */
Spike4DGS.controls = (() => {
  const { el, byId, fill, heading } = Spike4DGS.dom;
  const { facetValues } = Spike4DGS.model;
  const TITLES = { sensor: "Sensor", images: "Images from spikes", initialization: "Initialization", motion: "Motion",
    supervision: "Supervision", budget: "Budget", hardware: "Hardware", poses: "Poses",
    calibration: "Camera calibration", trained: "Trained on", verified: "Verified" };
  const SENSORS = {
    noisy: "The sensor is noisy: gains that differ from pixel to pixel, dark current with hot pixels, shot noise.",
    "partly noisy": "The sensor has some terms of the noise, and others are switched off.",
    ideal: "The sensor is ideal: no gains, no dark current, no shot noise.",
    recorded: "A real array recorded the spikes." };
  const LIMITS = { maxfit: "Fit at most, s a scene", minfps: "Images/s at least", maxmem: "Memory at most, MB",
    maxmodel: "Model at most, MB" };

  /* The links that answer a question in one click. The track is the first that withholds nothing. */
  function questions(page, link) {
    const tracks = page.boards.filter((b) => b.folder === "entries");
    const track = tracks.find((b) => !b.withheld.length) ?? page.boards[0];
    if (!track) return;
    const moving = { t: track.id, m: "psnr_dynamic" };
    const noisy = tracks.find((b) => !b.withheld.length && b.scenes.some((scene) => scene.sensor === "noisy"));
    const within = { ...moving, maxfit: "60" };
    const items = [
      ["Best overall", { t: track.id }],
      ["Best where things move", moving],
      ["… within a minute of fit", within],
      noisy && ["… and on a noisy sensor", { ...within, t: noisy.id, sensor: "noisy" }],
      noisy && ["… that is not calibrated", { ...within, t: noisy.id, sensor: "noisy", calibration: "not given" }],
      ["Fastest to render", { t: track.id, s: "render_fps" }],
    ].filter(Boolean);
    fill(byId("questions"), el("span", {}, "Questions: "), items.map(([text, state]) => el("a", { href: link(state) }, text)));
  }

  /* Fill a node again only where what it shows has changed. */
  function once(node, key, content) {
    if (node.dataset.key !== key) fill(node, content());
    node.dataset.key = key;
  }

  function tabs(page, board, link) {
    const groups = [["entries", "Release " + page.release], ["local", "Local"], ["archive", "Archive"]];
    once(byId("tabs"), board.id, () => groups.map(([folder, title]) => {
      const boards = page.boards.filter((b) => b.folder === folder);
      return boards.length && el("div", { class: "tabgroup" }, el("span", { class: "group" }, title),
        boards.map((b) => el("a", { href: link({ t: b.id }), "aria-current": b === board ? "page" : null }, b.label)));
    }));
  }

  function about(board) {
    const withheld = board.withheld.length ? `Methods are not given: ${board.withheld.join(", ")}. ` : "";
    const sensors = facetValues(board, "sensor").map((name) => SENSORS[name]).filter(Boolean);
    once(byId("about"), board.id, () => [
      el("h2", {}, board.label),
      el("p", {}, board.title === board.label ? "" : `${board.title}. `, withheld, board.why && `Not on a track: ${board.why}. `,
        `Split ${board.split}. `, sensors.join(" "))]);
  }

  let built = null; // the form's board and its parts that follow the state

  /* Show the state in the form, which is built again only for another board. */
  function form(page, board, state, view, change) {
    if (built?.board !== board) built = build(page, board, change);
    const { values, scenes, legend, every } = built;
    built.view = view;
    for (const [name, node] of values) {
      const value = name === "m" ? view.metric : state[name];
      if (node.tagName === "SELECT" && ![...node.options].some((o) => o.value === value)) node.append(el("option", { value }, value));
      if (node.value !== (value ?? "")) node.value = value ?? "";
    }
    const chosen = new Set(view.scenes);
    scenes.forEach((box, i) => { box.checked = chosen.has(i); });
    legend.textContent = `Scenes in the means (${view.scenes.length} of ${board.scenes.length})`;
    every.hidden = !state.scenes;
  }

  function build(page, board, change) {
    const values = new Map();
    const field = (title, name, control) => {
      values.set(name, control);
      return el("label", {}, el("span", {}, title), control);
    };
    const select = (title, name, options, set = (value) => ({ [name]: value })) => field(title, name,
      el("select", { name, onchange: (e) => change(set(e.target.value)) }, options.map(([v, text]) => el("option", { value: v }, text))));
    const input = (title, name, attributes) => field(title, name, el("input", { name, ...attributes, onchange: (e) => change({ [name]: e.target.value }) }));
    const facets = Object.entries(TITLES).map(([name, title]) =>
      select(title, name, [["", "any"], ...facetValues(board, name).map((v) => [v, v])]));
    const toggle = (i) => {
      const next = new Set(built.view.scenes);
      if (!next.delete(i)) next.add(i);
      const ids = [...next].sort((a, b) => a - b).map((j) => board.scenes[j].id);
      change({ scenes: ids.length === board.scenes.length || !ids.length ? null : ids });
    };
    const scenes = board.scenes.map((scene, i) => el("input", { type: "checkbox", name: "scene", value: scene.id, onchange: () => toggle(i) }));
    const every = el("button", { type: "button", onclick: () => change({ scenes: null }) }, "All scenes");
    const legend = el("legend", {});
    const open = byId("controls").querySelector("details")?.open ?? window.matchMedia("(min-width: 60rem)").matches;
    const ranked = Spike4DGS.model.metricsOf(board).map((id) => [id, heading(page.index.get(id))]);
    const number = { type: "number", min: "0", step: "any", inputmode: "decimal" };
    fill(byId("controls"),
      el("div", { class: "fields" },
        select("Rank by", "m", ranked, (m) => ({ m, s: "", d: "" })),
        select("Intervals are about", "iv", [["", "scenes like these"], ["fixed", "these scenes"]])),
      el("fieldset", {}, legend, el("div", { class: "checks" },
        scenes.map((box, i) => el("label", { class: "check" }, box, board.scenes[i].id)), every)),
      el("details", { open }, el("summary", {}, "Filters"),
        el("div", { class: "fields" }, input("Name contains", "q", { type: "search" }), facets,
          Object.entries(LIMITS).map(([name, title]) => input(title, name, number)))));
    return { board, values, scenes, legend, every };
  }

  return { questions, tabs, about, form };
})();
