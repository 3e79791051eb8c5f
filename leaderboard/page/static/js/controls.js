"use strict";
/* Questions, tabs and filters. They show the state and change it; `app` draws what follows. */
Spike4DGS.controls = (() => {
  const { el, byId, fill, heading } = Spike4DGS.dom;
  const { facet } = Spike4DGS.model;
  const TITLES = { images: "Images from spikes", initialization: "Initialization", motion: "Motion",
    supervision: "Supervision", budget: "Budget", hardware: "Hardware", poses: "Poses",
    calibration: "Camera calibration", trained: "Trained on", verified: "Verified" };
  const LIMITS = { maxfit: "Fit at most, s a scene", minfps: "Images/s at least", maxmem: "Memory at most, MB",
    maxmodel: "Model at most, MB" };

  /* The links that answer a question in one click. The track is the open one with the most rows. */
  function questions(page, link) {
    const tracks = page.boards.filter((b) => b.folder === "entries");
    const track = tracks.find((b) => !b.withheld.length) ?? page.boards[0];
    if (!track) return;
    const moving = { t: track.id, m: "psnr_dynamic" };
    const items = [
      ["Best overall", { t: track.id }],
      ["Best where things move", moving],
      ["… within a minute of fit", { ...moving, maxfit: "60" }],
      ["… on a noisy sensor that is not calibrated", { ...moving, maxfit: "60", calibration: "not given" }],
      ["Fastest to render", { t: track.id, s: "render_fps" }],
    ];
    fill(byId("questions"), el("span", {}, "Questions: "), items.map(([text, state]) => el("a", { href: link(state) }, text)));
  }

  function tabs(page, board, link) {
    const groups = [["entries", "Release " + page.release], ["local", "Local"], ["archive", "Archive"]];
    fill(byId("tabs"), groups.map(([folder, title]) => {
      const boards = page.boards.filter((b) => b.folder === folder);
      return boards.length && el("div", { class: "tabgroup" }, el("span", { class: "group" }, title),
        boards.map((b) => el("a", { href: link({ t: b.id }), "aria-current": b === board ? "page" : null }, b.name)));
    }));
  }

  function about(page, board) {
    const withheld = board.withheld.length ? `Methods are not given: ${board.withheld.join(", ")}. ` : "";
    fill(byId("about"),
      el("h2", {}, board.name),
      el("p", {}, board.title === board.name ? "" : `${board.title}. `, withheld, board.why && `Not on a track: ${board.why}. `,
        `Split ${board.split}. `, board.sensor));
  }

  function form(page, board, state, view, change) {
    const field = (title, control) => el("label", {}, el("span", {}, title), control);
    const metricOptions = board.scored.map((id) => {
      const metric = page.index.get(id);
      return el("option", { value: id, selected: id === view.metric }, heading(metric));
    });
    const selects = Object.keys(TITLES).map((name) => {
      const values = [...new Set(board.rows.map((row) => facet(row, name)))].sort();
      if (state[name] && !values.includes(state[name])) values.push(state[name]);
      const options = [["", "any"], ...values.map((v) => [v, v])];
      return field(TITLES[name], el("select", { name, onchange: (e) => change({ [name]: e.target.value }) },
        options.map(([v, text]) => el("option", { value: v, selected: v === state[name] }, text))));
    });
    const limits = Object.entries(LIMITS).map(([name, title]) =>
      field(title, el("input", { name, type: "number", min: "0", step: "any", inputmode: "decimal", value: state[name],
        onchange: (e) => change({ [name]: e.target.value }) })));
    const toggle = (i) => {
      const next = new Set(view.scenes);
      if (!next.delete(i)) next.add(i);
      const ids = [...next].sort((a, b) => a - b).map((j) => board.scenes[j].id);
      change({ scenes: ids.length === board.scenes.length || !ids.length ? null : ids });
    };
    const scenes = board.scenes.map((scene, i) => el("label", { class: "check" },
      el("input", { type: "checkbox", name: "scene", value: scene.id, checked: view.scenes.includes(i), onchange: () => toggle(i) }),
      scene.id));
    const about = [["", "scenes like these"], ["fixed", "these scenes"]];
    const open = byId("controls").querySelector("details")?.open ?? window.matchMedia("(min-width: 60rem)").matches;
    const focused = document.activeElement?.name;
    fill(byId("controls"),
      el("div", { class: "fields" },
        field("Rank by", el("select", { name: "m", onchange: (e) => change({ m: e.target.value, s: "", d: "" }) }, metricOptions)),
        field("Intervals are about", el("select", { name: "iv", onchange: (e) => change({ iv: e.target.value }) },
          about.map(([v, text]) => el("option", { value: v, selected: v === state.iv }, text))))),
      el("fieldset", {}, el("legend", {}, `Scenes in the means (${view.scenes.length} of ${board.scenes.length})`),
        el("div", { class: "checks" }, scenes,
          state.scenes && el("button", { type: "button", onclick: () => change({ scenes: null }) }, "All scenes"))),
      el("details", { open }, el("summary", {}, "Filters"),
        el("div", { class: "fields" },
          field("Name contains", el("input", { name: "q", type: "search", value: state.q, onchange: (e) => change({ q: e.target.value }) })),
          selects, limits)));
    const again = focused && byId("controls").elements[focused];
    if (again) (again.length && !again.tagName ? again[0] : again).focus();
  }

  return { questions, tabs, about, form };
})();
