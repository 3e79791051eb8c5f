"use strict";
/* From a board and the state to the rows on the screen. Pure functions of their arguments. */
Spike4DGS.model = (() => {
  const DEFAULT_COLUMNS = ["psnr", "psnr_dynamic", "ssim", "flip"];
  const MOST_REMEMBERED = 200; // columns and choices of scenes of a board
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

  /* Return the numbers of the chosen scenes; all of them where none of the names is the board's. Of these only the ones
     of the chosen sensor count, if there are any: else the filter hides all rows. */
  function chosenScenes(board, state) {
    const wanted = new Set(state.scenes ?? []);
    const every = board.scenes.map((_, i) => i);
    const named = every.filter((i) => wanted.has(board.scenes[i].id));
    const chosen = named.length ? named : every;
    const sensed = state.sensor ? chosen.filter((i) => board.scenes[i].sensor === state.sensor) : chosen;
    return sensed.length ? sensed : chosen;
  }

  /* Return whether a row stands below the others: an entry without a rank, such as a claim or a flagged one, on a board
     that has ranks. Nobody vouches for an own run, but for its reader. */
  const isBelow = (board, row) => board.scored.length > 0 && !row.ranked && row.label !== "own run";

  const cache = new WeakMap(); // board -> what was computed of it before, by a text

  function remembered(board, key, compute) {
    if (!cache.has(board)) cache.set(board, new Map());
    const of = cache.get(board);
    if (!of.has(key)) {
      if (of.size >= MOST_REMEMBERED) of.clear();
      of.set(key, compute());
    }
    return of.get(key);
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

  /* Return every row's mean of a column, and every row's scenes that were not scored: filters change neither. */
  const means = (board, column, scenes) =>
    remembered(board, `mean ${column} ${scenes}`, () => board.rows.map((row) => mean(row, column, scenes)));
  const missing = (board, scenes) =>
    remembered(board, `missing ${scenes}`, () => board.rows.map((row) => scenes.filter((s) => row.cells[s].why)));

  /* Return the values of a facet on a board, sorted. */
  const facetValues = (board, name) =>
    remembered(board, `facet ${name}`, () => (name === "sensor" ? board.scenes.map((scene) => scene.sensor) : board.rows.map((row) => facet(row, name)))
      .filter((v, i, all) => all.indexOf(v) === i).sort());

  function publishedMean(board, index, metric, scenes) {
    const values = board.published?.rows[index]?.[metric];
    if (!values || scenes.some((s) => values[s] === null)) return null;
    return scenes.reduce((sum, s) => sum + values[s], 0) / scenes.length;
  }

  /* Return the metrics to choose from: those that rows are compared by, or the usual ones where no row may be ranked. */
  const metricsOf = (board) => (board.scored.length ? board.scored : DEFAULT_COLUMNS);

  function primaryOf(page, board, state) {
    const known = metricsOf(board);
    return known.includes(state.m) ? state.m : known.includes(page.primary) ? page.primary : known[0];
  }

  /* Return the metrics that are columns: the one ranked by first, then the usual ones that any row has. */
  function columns(page, board, metric) {
    const ids = [metric, ...DEFAULT_COLUMNS.filter((m) => m !== metric && metricsOf(board).includes(m)), ...COSTS];
    return ids.map((id) => page.index.get(id));
  }

  /* Return why a row is hidden by the filters, or an empty text. */
  function hiddenBy(row, values, state, limits, facets) {
    if (state.q && !row.name.toLowerCase().includes(state.q)) return "name";
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
    const columnMeans = shownColumns.map((c) => [c.id, means(board, c.number, scenes)]);
    const lacking = missing(board, scenes);
    const asked = { ...state, q: state.q.toLowerCase() };
    const sensed = !state.sensor || scenes.every((s) => board.scenes[s].sensor === state.sensor);
    board.rows.forEach((row, index) => {
      const values = {};
      for (const [id, all] of columnMeans) values[id] = all[index];
      const why = sensed ? hiddenBy(row, values, asked, limits, facets) : "sensor";
      const item = { row, index, values, missing: lacking[index], published: publishedMean(board, index, metric, scenes), why };
      (why ? hidden : shown).push(item);
    });
    const column = page.index.get(state.s) && shownColumns.includes(page.index.get(state.s)) ? state.s : metric;
    const sortBy = state.s === "name" ? "name" : column;
    const higher = sortBy === "name" ? false : page.index.get(sortBy)?.higher;
    const descending = state.d ? state.d === "desc" : higher;
    shown.sort(order(board, sortBy, descending));
    return { board, scenes, metric, columns: shownColumns, shown, hidden, sortBy, descending };
  }

  function order(board, column, descending) {
    const sign = descending ? -1 : 1;
    const byName = (a, b) => (a.row.name < b.row.name ? -1 : a.row.name > b.row.name ? 1 : a.index - b.index);
    if (column === "name") return (a, b) => sign * byName(a, b);
    const proven = (item) => (item.row.unverified.includes(column) ? null : item.values[column]);
    const below = (item) => isBelow(board, item.row);
    return (a, b) => {
      if (below(a) !== below(b)) return below(a) - below(b);
      const x = proven(a);
      const y = proven(b);
      if (x === null || y === null) return (x === null) - (y === null) || byName(a, b);
      return sign * (x - y) || byName(a, b);
    };
  }

  return { COSTS, facetValues, isBelow, metricsOf, view };
})();
