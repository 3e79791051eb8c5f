"use strict";
/* What the reader chose, all of it in the address: a link shows the same. Defaults are left out of it. */
Spike4DGS.state = (() => {
  const FACETS = ["images", "initialization", "motion", "supervision", "budget", "hardware", "poses", "calibration",
    "trained", "verified"];
  const LIMITS = ["maxfit", "minfps", "maxmem", "maxmodel"];
  const TEXTS = ["t", "m", "s", "d", "q", "sensor", "iv", "color", "scene", "a", "b", "e", "row", ...FACETS, ...LIMITS];
  const NUMBERS = ["k", "split"];

  function parse(hash) {
    const given = new URLSearchParams(hash.replace(/^#/, ""));
    const state = { scenes: null, all: false, crop: false, k: null, split: null };
    for (const key of TEXTS) state[key] = given.get(key) ?? "";
    for (const key of NUMBERS) {
      const value = Number.parseInt(given.get(key), 10);
      state[key] = Number.isFinite(value) ? value : null;
    }
    if (given.has("scenes")) state.scenes = given.get("scenes").split(",").filter(Boolean);
    state.all = given.get("all") === "1";
    state.crop = given.get("crop") === "1";
    return state;
  }

  function serialize(state) {
    const out = new URLSearchParams();
    for (const key of TEXTS) if (state[key]) out.set(key, state[key]);
    for (const key of NUMBERS) if (state[key] !== null) out.set(key, state[key]);
    if (state.scenes) out.set("scenes", state.scenes.join(","));
    if (state.all) out.set("all", "1");
    if (state.crop) out.set("crop", "1");
    return `#${out}`;
  }

  /* Return the limits as numbers; those that are empty or no number are left out. */
  function limits(state) {
    const read = (key) => (state[key] === "" ? null : Number(state[key]));
    return Object.fromEntries(LIMITS.map((k) => [k, read(k)]).filter(([, v]) => v !== null && Number.isFinite(v)));
  }

  /* Return the state without any filter of rows. */
  const unfiltered = (state) => ({ ...state, q: "", sensor: "", ...Object.fromEntries([...FACETS, ...LIMITS].map((k) => [k, ""])) });

  return { FACETS, LIMITS, parse, serialize, limits, unfiltered };
})();
