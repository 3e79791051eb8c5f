"use strict";
/* From the address to the screen: read the state, compute the view, draw it; a change writes the address. */
Spike4DGS.app = (() => {
  const { el, byId, fill, plural } = Spike4DGS.dom;
  const { parse, serialize, unfiltered } = Spike4DGS.state;
  const MOST_COMPARED = 200; // rows whose intervals are computed here; for all scenes they come with the page
  const cache = new Map();
  let page;

  const link = (state) => serialize({ ...parse(""), ...state });

  function boardOf(state) {
    return page.boards.find((b) => b.id === state.t) ?? page.boards[0];
  }

  /* Change the state. `quiet` changes do not draw again: what they change is already on the screen. */
  function change(changes, quiet = false) {
    const next = serialize({ ...parse(location.hash), ...changes });
    if (quiet) history.replaceState(null, "", next);
    else if (next !== location.hash) location.hash = next;
  }

  /* Return {rows, better, leftOut} of the view's metric and scenes: as built where all scenes count, else computed.
     Null where that takes a while and was not done yet; `wait` does it. */
  function comparison(view, state, wait) {
    if (!view.board.scored.length) return { rows: [], better: [], leftOut: {} };
    const number = page.boards.indexOf(view.board);
    const scores = Spike4DGS.ready(`scores-${number}-${view.metric}`);
    if (!scores) return null;
    const fixed = state.iv === "fixed";
    if (view.scenes.length === view.board.scenes.length && !fixed) return scores;
    const key = [number, view.metric, view.scenes, fixed].join("|");
    if (!cache.has(key) && wait) cache.set(key, computed(view, scores, fixed));
    return cache.get(key) ?? null;
  }

  function computed(view, scores, fixed) {
    if (scores.rows.length > MOST_COMPARED || !scores.rows.length) {
      const why = Object.fromEntries(scores.rows.map((i) => [i, `intervals of more than ${MOST_COMPARED} rows come for all scenes only`]));
      return { rows: [], better: [], leftOut: { ...scores.leftOut, ...why } };
    }
    const values = Spike4DGS.intervals.nested(scores, view.scenes);
    const worlds = view.scenes.map((s) => view.board.worlds[s]);
    const found = Spike4DGS.intervals.compare(values, worlds, page.index.get(view.metric).higher, page.bootstrap, fixed);
    return { ...scores, better: found.better };
  }

  let drawing = 0;

  async function draw() {
    const turn = ++drawing;
    const state = parse(location.hash);
    const board = boardOf(state);
    document.body.dataset.ready = "";
    if (!board) return;
    const view = Spike4DGS.model.view(page, board, state);
    const act = { change, unfilter: () => { location.hash = serialize(unfiltered(parse(location.hash))); } };
    document.title = `${board.label}: Spike4DGS leaderboard`;
    Spike4DGS.controls.tabs(page, board, link);
    Spike4DGS.controls.about(board);
    Spike4DGS.controls.form(page, board, state, view, change);
    const shown = view.shown.map((item) => item.index);
    let found = comparison(view, state, false);
    if (!found) {
      Spike4DGS.table.draw(page, state, view, null, {}, act);
      document.body.dataset.drawn = location.hash || "#";
      await Spike4DGS.load(`scores-${page.boards.indexOf(board)}-${view.metric}`);
      await painted();
      if (turn !== drawing) return;
      found = comparison(view, state, true);
    }
    const ranks = Spike4DGS.intervals.ranks(found.rows, found.better, shown);
    Spike4DGS.table.draw(page, state, view, ranks, found.leftOut, act);
    document.body.dataset.drawn = location.hash || "#";
    Spike4DGS.download.buttons(page, view, state, ranks);
    await Spike4DGS.details.draw(page, state, view, () => change({ row: "" }));
    document.body.dataset.ready = location.hash || "#";
    // What lies below the first screen may wait for the next frame.
    await painted();
    if (turn !== drawing) return;
    Spike4DGS.table.finish();
    await Spike4DGS.plots.draw(page, state, view, change, () => turn === drawing);
    if (turn !== drawing) return;
    await Spike4DGS.compare.draw(page, state, view, change);
    if (turn === drawing) document.body.dataset.whole = location.hash || "#";
  }

  const painted = () => new Promise((resolve) => requestAnimationFrame(() => setTimeout(resolve)));

  /* A page of the documentation, where it is known. */
  const docs = (path, text) => page.docs && el("a", { href: page.docs + path }, text);

  function links() {
    const submit = el("a", { href: "#" }, "Submit a result");
    submit.addEventListener("click", (e) => {
      e.preventDefault();
      byId("submit").open = true;
      byId("submit").scrollIntoView();
      byId("submit").querySelector("summary").focus();
    });
    fill(byId("links"), docs("index.html", "Documentation"), docs("methods/index.html", "Methods"), submit);
  }

  function submitting() {
    const lines = [
      "spike4dgs run-benchmark --track ideal --methods NAME --out runs/mine",
      "spike4dgs leaderboard --runs runs/mine   # your row among these",
      "spike4dgs submit runs/mine/results/NAME.json --predictions runs/mine/predictions/NAME --scenes data/*-small"];
    return el("details", { id: "submit" }, el("summary", {}, "Submit a result"),
      el("p", {}, "A track takes every record of exactly its scenes, scored again from the predictions: those of run-benchmark, or of score for the images of any program."),
      el("pre", {}, lines.join("\n")),
      page.docs && el("p", {}, "More: ", docs("leaderboard/index.html#submit", "how to submit"), ", ", docs("external_methods/index.html", "your own method"), "."));
  }

  function footer() {
    const empty = page.empty.map((t) => `${t.name} (${t.announced ? "announced" : "open"})`).join(", ");
    fill(byId("footer"),
      el("p", {}, `Intervals: a paired bootstrap over worlds, images and seeds, ${page.bootstrap.replicates} replicates. Of less than ${page.bootstrap.fewestWorlds} worlds only images and seeds are drawn, and the intervals are about these scenes. `,
        "Fit time, images/s, memory and model size are what each entry claims."),
      empty && el("p", {}, `Tracks without entries: ${empty}.`),
      page.refused.length ? el("details", {}, el("summary", {}, `${plural(page.refused.length, "entry").replace("entrys", "entries")} not listed`),
        el("ul", {}, page.refused.map((r) => el("li", {}, `${r.entry}: ${r.reason}`)))) : null,
      submitting(),
      el("p", {}, "Plots: Observable Plot 0.6.17 and D3 7.9.2 (ISC licence), included."));
  }

  function start(data) {
    page = data;
    page.index = new Map(page.metrics.map((metric, number) => [metric.id, { ...metric, number }]));
    page.published = (board) => board.published;
    page.hint = "No images here: build the page with --runs and --data to see truth and methods side by side.";
    page.one = "One image, as it comes with the entries, compressed. Build the page with --runs and --data to see all.";
    links();
    Spike4DGS.controls.questions(page, link);
    byId("controls").addEventListener("submit", (e) => e.preventDefault());
    byId("skip").addEventListener("click", (e) => { e.preventDefault(); byId("scroller").focus(); });
    window.addEventListener("hashchange", draw);
    footer();
    return draw();
  }

  window.addEventListener("DOMContentLoaded", () => Spike4DGS.load("boards").then(start));
  return { link, current: () => ({ page, state: parse(location.hash), view: Spike4DGS.model.view(page, boardOf(parse(location.hash)), parse(location.hash)) }) };
})();
