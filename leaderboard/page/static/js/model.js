"use strict";
/* From a board and the state to the rows on the screen. Pure functions of their arguments. */
Spike4DGS.model = (() => {
  const DEFAULT_COLUMNS = ["psnr", "psnr_dynamic", "ssim", "flip"];
  const COSTS = ["fit_seconds", "render_fps", "peak_memory_mb", "model_mb"];

  /* Return the value of a facet that rows are filtered by. */
  function facet(row, name) {
    if (name in row.parts) return row.parts[name];
    if (name === "poses") return row.given.includes("poses") ? "given" : "not given";
    if (name === "calibration") return row.given.includes("flat-field") ? "given" : "not given";
    if (name === "trained") return row.trainedOn ? "other data" : "nothing";
    if (name === "verified") return row.label;
    return row[name];
  }

  /* Return the numbers of the chosen scenes; all of them where none of the names is the board's. */
  function chosenScenes(board, state) {
    const wanted = new Set(state.scenes ?? []);
    const chosen = board.scenes.map((_, i) => i).filter((i) => wanted.has(board.scenes[i].id));
    return chosen.length ? chosen : board.scenes.map((_, i) => i);
  }

  /* Return the mean over scenes, null where one has no value: never a mean over fewer. */
  function mean(row, column, scenes) {
    let sum = 0;
    for (const s of scenes) {
      const value = row.cells[s].v[column];
      if (value === null) return null;
      sum += value;
    }
    return sum / scenes.length;
  }

  function publishedMean(board, index, metric, scenes) {
    const values = board.published?.rows[index]?.[metric];
    if (!values || scenes.some((s) => values[s] === null)) return null;
    return scenes.reduce((sum, s) => sum + values[s], 0) / scenes.length;
  }

  const primaryOf = (page, board, state) =>
    board.scored.includes(state.m) ? state.m : board.scored.includes(page.primary) ? page.primary : board.scored[0];

  /* Return the metrics that are columns: the one ranked by first, then the usual ones that any row has. */
  function columns(page, board, metric) {
    const ids = [metric, ...DEFAULT_COLUMNS.filter((m) => m !== metric && board.scored.includes(m)), ...COSTS];
    return ids.filter(Boolean).map((id) => page.index.get(id));
  }

  /* Return why a row is hidden by the filters, or an empty text. */
  function hiddenBy(row, values, state, limits, facets) {
    if (state.q && !row.name.toLowerCase().includes(state.q.toLowerCase())) return "name";
    for (const name of facets) if (facet(row, name) !== state[name]) return name;
    // A row without the cost cannot be said to be within the limit.
    const within = (limit, cost, sign) =>
      limits[limit] === undefined || (values[cost] !== null && sign * values[cost] <= sign * limits[limit]);
    if (!within("maxfit", "fit_seconds", 1)) return "fit";
    if (!within("minfps", "render_fps", -1)) return "images/s";
    if (!within("maxmem", "peak_memory_mb", 1)) return "memory";
    if (!within("maxmodel", "model_mb", 1)) return "model";
    return "";
  }

  /* Return the view of a board: columns, shown and hidden rows with their means, in the order of the sort. */
  function view(page, board, state) {
    const scenes = chosenScenes(board, state);
    const metric = primaryOf(page, board, state);
    const shownColumns = columns(page, board, metric);
    const limits = Spike4DGS.state.limits(state);
    const facets = Spike4DGS.state.FACETS.filter((name) => state[name]);
    const shown = [];
    const hidden = [];
    board.rows.forEach((row, index) => {
      const values = {};
      for (const c of shownColumns) values[c.id] = mean(row, c.number, scenes);
      const missing = scenes.filter((s) => row.cells[s].why);
      const item = { row, index, values, missing, published: publishedMean(board, index, metric, scenes) };
      const why = hiddenBy(row, values, state, limits, facets);
      (why ? hidden : shown).push({ ...item, why });
    });
    const column = page.index.get(state.s) && shownColumns.includes(page.index.get(state.s)) ? state.s : metric;
    const sortBy = state.s === "name" ? "name" : column;
    const higher = sortBy === "name" ? false : page.index.get(sortBy)?.higher;
    const descending = state.d ? state.d === "desc" : higher;
    shown.sort(order(sortBy, descending));
    return { board, scenes, metric, columns: shownColumns, shown, hidden, sortBy, descending };
  }

  function order(column, descending) {
    const sign = descending ? -1 : 1;
    const byName = (a, b) => (a.row.name < b.row.name ? -1 : a.row.name > b.row.name ? 1 : a.index - b.index);
    if (column === "name") return (a, b) => sign * byName(a, b);
    return (a, b) => {
      const x = a.values[column];
      const y = b.values[column];
      if (x === null || y === null) return (x === null) - (y === null) || byName(a, b);
      return sign * (x - y) || byName(a, b);
    };
  }

  return { COSTS, facet, chosenScenes, mean, columns, view };
})();
