"use strict";
/* Rank intervals over the scenes that the reader chose: the twin of leaderboard/page/intervals.py, with the same random
   numbers. A test compares the two. */
Spike4DGS.intervals = (() => {
  function lowbias32(x) {
    x = Math.imul(x ^ (x >>> 16), 0x7feb352d);
    x = Math.imul(x ^ (x >>> 15), 0x846ca68b);
    return (x ^ (x >>> 16)) >>> 0;
  }

  /* Return the resampled means [replicates][methods]; `values` [method][scene][image][seed]. */
  function resampledMeans(values, resampleScenes, replicates, seed) {
    const sizes = values[0].map((scene) => scene.length);
    const longest = Math.max(...sizes);
    const seeds = values.map((method) => method[0][0].length);
    const stride = 1 + longest + Math.max(...seeds);
    const key = lowbias32(seed);
    const bits = (counter) => lowbias32(counter ^ key);
    const below = (n, word) => Math.floor((word * n) / 4294967296);
    const means = [];
    for (let r = 0; r < replicates; r++) {
      const sums = new Float64Array(values.length);
      for (let slot = 0; slot < sizes.length; slot++) {
        const first = (r * sizes.length + slot) * stride;
        const scene = resampleScenes ? below(sizes.length, bits(first)) : slot;
        const n = sizes[scene];
        const images = Array.from({ length: n }, (_, k) => below(n, bits(first + 1 + k)));
        values.forEach((method, m) => {
          let sum = 0;
          for (let s = 0; s < seeds[m]; s++) {
            const drawn = seeds[m] === 1 ? 0 : below(seeds[m], bits(first + 1 + longest + s));
            for (const image of images) sum += method[scene][image][drawn];
          }
          sums[m] += sum / (n * seeds[m] * sizes.length);
        });
      }
      means.push(sums);
    }
    return means;
  }

  /* Return the value of a table over `grid` at x, between its entries on a line, and at its ends beyond them. */
  function interpolate(x, grid, table) {
    if (x <= grid[0]) return table[0];
    const last = grid.length - 1;
    if (x >= grid[last]) return table[last];
    let i = 0;
    while (grid[i + 1] < x) i++;
    return table[i] + ((x - grid[i]) / (grid[i + 1] - grid[i])) * (table[i + 1] - table[i]);
  }

  /* Return scores by world: the images of its scenes, one after the other. `worlds` has each scene's. */
  const byWorld = (values, worlds) =>
    values.map((method) => [...new Set(worlds)].map((world) => method.filter((_, s) => worlds[s] === world).flat()));

  const meansOf = (values) => values.map((method) => average(method.map((scene) => average(scene.map(average)))));

  /* Return { means, better }: better[i][j] where method i is better than j beyond the interval of their difference. */
  function compare(values, worlds, higher, settings, fixed = false) {
    const n = values.length;
    const resampled = !fixed && new Set(worlds).size >= settings.fewestWorlds;
    const drawn = resampled ? byWorld(values, worlds) : values;
    const means = meansOf(values);
    const centres = meansOf(drawn);
    const draws = resampledMeans(drawn, resampled, settings.replicates, settings.seed);
    const largest = new Float64Array(settings.replicates);
    const errors = Array.from({ length: n }, () => new Float64Array(n));
    for (let i = 0; i < n; i++) {
      for (let j = i + 1; j < n; j++) {
        const centre = centres[i] - centres[j];
        let squares = 0;
        for (const d of draws) squares += (d[i] - d[j] - centre) ** 2;
        const spread = Math.sqrt(squares / draws.length);
        errors[i][j] = errors[j][i] = spread;
        if (spread > 0) draws.forEach((d, r) => (largest[r] = Math.max(largest[r], Math.abs(d[i] - d[j] - centre) / spread)));
      }
    }
    const critical = Math.max(largest.slice().sort()[Math.ceil(settings.level * settings.replicates) - 1], settings.joint[n]);
    const units = resampled ? drawn[0].length : drawn[0].reduce((sum, scene) => sum + scene.length, 0);
    const table = settings.widened[Math.min(units, settings.widened.length - 1)];
    const wide = table ? interpolate(critical, settings.grid, table) : Infinity;
    const sign = higher ? 1 : -1;
    const half = (i, j) => (table ? errors[i][j] * wide : Infinity);
    const better = means.map((a, i) => means.map((b, j) => i !== j && sign * (a - b) > half(i, j)));
    return { means, better };
  }

  const average = (list) => list.reduce((a, b) => a + b, 0) / list.length;

  /* Return scores as [method][scene][image][seed]: a file has numbers in the place of lists of one seed. */
  const nested = (scores, scenes) =>
    scores.values.map((row) => scenes.map((s) => row[s].map((v) => (Array.isArray(v) ? v : [v]))));

  const matrices = new WeakMap();

  /* Return the comparison as bytes, row by row; the page comes with texts of 0 and 1. */
  function matrix(better) {
    if (!matrices.has(better)) {
      const n = better.length;
      const bytes = new Uint8Array(n * n);
      better.forEach((line, i) => {
        for (let j = 0; j < n; j++) bytes[i * n + j] = typeof line === "string" ? line.charCodeAt(j) - 48 : Number(line[j]);
      });
      matrices.set(better, bytes);
    }
    return matrices.get(better);
  }

  /* Return for each of the `shown` row numbers { best, worst, ties() } among them; rows that are not compared have none. */
  function ranks(rows, better, shown) {
    const bytes = matrix(better);
    const n = better.length;
    const place = new Map(rows.map((row, k) => [row, k]));
    const compared = shown.filter((index) => place.has(index)).map((index) => place.get(index));
    const found = new Map();
    for (const k of compared) {
      let above = 0;
      let under = 0;
      for (const j of compared) {
        above += bytes[j * n + k];
        under += bytes[k * n + j];
      }
      const ties = () => compared.filter((j) => j !== k && !bytes[j * n + k] && !bytes[k * n + j]).map((j) => rows[j]);
      found.set(rows[k], { best: 1 + above, worst: compared.length - under, ties });
    }
    return found;
  }

  return { compare, nested, ranks, resampledMeans };
})();
