"use strict";
/* The ranking: a real table, with what is hidden counted above it. */
Spike4DGS.table = (() => {
  const { el, byId, fill, format, heading, plural } = Spike4DGS.dom;
  const { isBelow } = Spike4DGS.model;
  const MOST = 50; // rows that are drawn, for speed; a button shows the others
  const SCREEN = 20; // rows that are drawn at once; the rest follows when these are on the screen
  let rest = () => {};
  const PROOFS = { // what a label proves, and what it does not
    claimed: "nothing was computed again.",
    "re-scored": "the images have these scores. Who made them, and from what, is not proven.",
    "re-fitted": "the method reaches these scores when it is fitted again, by a process that is given the training part of a scene alone. "
      + "A process can read every file that its user can read, and public scenes can be rendered by everybody: only a container (submit --refit "
      + "--container) keeps a method from files that it looks for, and only a season's scenes are unknown to it.",
  };
  const labelOf = (row) => (row.apart ? `${row.label} (${row.apart})` : row.label);

  /* `ranks`: row number -> {best, worst, ties()}; null while they are computed. `leftOut`: why others have none. */
  function draw(page, state, view, ranks, leftOut, act) {
    const rows = state.all ? view.shown : view.shown.slice(0, MOST);
    const metric = page.index.get(view.metric);
    const names = page.published(view.board)?.names ?? {};
    const paper = view.metric in names && view.shown.some((item) => item.published !== null);
    const sortHeader = (id, title, hint) => {
      const sorted = view.sortBy === id ? (view.descending ? "descending" : "ascending") : null;
      const flip = () => act.change({ s: id, d: sorted ? (view.descending ? "asc" : "desc") : "" });
      return el("th", { scope: "col", "aria-sort": sorted, class: id === "name" ? "name" : "number" },
        el("button", { type: "button", title: hint, onclick: flip }, title, sorted && el("span", { class: "arrow", "aria-hidden": "true" }, view.descending ? " ▼" : " ▲")));
    };
    const head = el("thead", {}, el("tr", {},
      el("th", { scope: "col", class: "number" }, "Rank"),
      sortHeader("name", "Method", "Sort by name"),
      view.columns.map((c) => [
        sortHeader(c.id, c.id === "fit_seconds" ? "fit, s a scene" : heading(c), c.definition),
        c === metric && paper && el("th", { scope: "col", class: "number paper", title: view.board.published.source }, `${names[view.metric]}, paper`)]),
      el("th", { scope: "col" }, "Verified")));
    const best = bestValues(view);
    const labels = new Set(view.shown.map((item) => item.row.label));
    const line = (item) => el("tr", { "data-row": item.row.name },
      rankCell(view, item, ranks, leftOut),
      el("th", { scope: "row", class: "name" },
        el("button", { type: "button", class: "link", "aria-haspopup": "dialog", onclick: () => act.change({ row: item.row.name }) }, item.row.name),
        note(view, item)),
      view.columns.map((c) => [
        el("td", { class: isBest(view, item, c, best) ? "number best" : "number" }, format(c, item.values[c.id])),
        c === metric && paper && el("td", { class: "number paper" }, format(c, item.published))]),
      el("td", { class: "nowrap", title: PROOFS[item.row.label] }, labelOf(item.row)));
    const body = el("tbody", {}, rows.slice(0, SCREEN).map(line));
    rest = () => body.append(...rows.slice(SCREEN).map(line));
    const ranked = `ranks by ${heading(metric)} among the rows shown, with ${Math.round(100 * page.bootstrap.level)} % intervals that hold `
      + "together; methods that cannot be told apart tie (=).";
    const timed = view.shown.filter(({ values }) => values.fit_seconds !== null || values.render_fps !== null);
    const machines = new Set(timed.map(({ row }) => row.hardware));
    const caption = el("caption", {}, el("div", {}, `Means over ${plural(view.scenes.length, "scene")}; `,
      view.board.scored.length ? ranked : "no row of this board is ranked.",
      machines.size > 1 && " Fit times and images/s are of different machines: do not compare them."));
    // The page keeps its height meanwhile: what is read further down does not jump.
    if (rows.length > SCREEN) byId("scroller").style.minHeight = `${byId("scroller").offsetHeight}px`;
    fill(byId("table"), caption, head, body);
    fill(byId("below"),
      view.shown.length > rows.length && el("button", { type: "button", id: "more", onclick: () => act.change({ all: true }) },
        `Show all ${view.shown.length} rows`),
      paper && el("p", { class: "small" }, `Paper: ${view.board.published.source}`),
      el("p", { class: "small" }, el("strong", {}, "Verified. "), Object.entries(PROOFS).filter(([label]) => labels.has(label))
        .map(([label, text]) => [el("em", {}, label), `: ${text} `])));
    count(view, rows.length, act);
  }

  const isClaimed = (item, c) => item.row.unverified.includes(c.id);
  const counts = (view, item, c) => !isClaimed(item, c) && !isBelow(view.board, item.row) && item.values[c.id] !== null;
  const isBest = (view, item, c, best) => counts(view, item, c) && item.values[c.id] === best[c.id];

  function bestValues(view) {
    const found = {};
    for (const c of view.columns) {
      const values = view.shown.filter((item) => counts(view, item, c)).map((item) => item.values[c.id]);
      found[c.id] = values.length ? (c.higher ? Math.max(...values) : Math.min(...values)) : null;
    }
    return found;
  }

  function rankCell(view, item, ranks, leftOut) {
    if (ranks === null) return el("td", { class: "number rank" }, "…");
    const rank = ranks.get(item.index);
    if (!rank) {
      const why = leftOut[item.index] ?? (item.row.why || "not compared");
      return el("td", { class: "number rank", title: why }, "–", el("span", { class: "hidden-text" }, ` no rank: ${why}`));
    }
    const text = rank.best === rank.worst ? String(rank.best) : `${rank.best}–${rank.worst}`;
    const tied = rank.ties().map((i) => view.board.rows[i].name);
    const said = tied.length ? `cannot be told apart from ${tied.join(", ")}` : "told apart from every other row";
    return el("td", { class: "number rank", title: said }, tied.length ? "= " : "", text, el("span", { class: "hidden-text" }, `, ${said}`));
  }

  function note(view, item) {
    const lines = [];
    if (item.missing.length) {
      const which = item.missing.map((s) => `${view.board.scenes[s].id} ${item.row.cells[s].why}`);
      lines.push(`incomplete: ${which.join("; ")}`);
    } else if (!item.row.ranked && item.row.why) lines.push(`not ranked: ${item.row.why}`);
    const claimed = view.columns.filter((c) => isClaimed(item, c) && item.row.label !== "claimed");
    if (claimed.length) lines.push(`as claimed, not computed again: ${claimed.map((c) => c.title).join(", ")}`);
    if (item.row.seeds.length > 1) lines.push(`${item.row.seeds.length} seeds`);
    return lines.map((text) => el("div", { class: "note" }, text));
  }

  function count(view, drawn, act) {
    const hidden = view.hidden.length;
    const more = view.shown.length > drawn ? `, the first ${drawn} drawn` : "";
    fill(byId("count"),
      el("span", {}, `${plural(view.shown.length, "row")}${more}; ${plural(hidden, "row")} hidden by filters`),
      hidden > 0 && el("button", { type: "button", onclick: act.unfilter }, "Show them"));
  }

  /* Draw the rows below the first screen. */
  function finish() {
    rest();
    rest = () => {};
    byId("scroller").style.minHeight = "";
  }

  return { draw, finish, labelOf };
})();
