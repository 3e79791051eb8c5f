"use strict";
/* The one global. Data come as scripts, because a page from a disk may not fetch: `load` adds the script, which calls
   `receive` with a JSON text. */
window.Spike4DGS = (() => {
  const found = new Map();
  const waiting = new Map();

  function receive(name, text) {
    found.set(name, JSON.parse(text));
    if (waiting.has(name)) waiting.get(name).resolve(found.get(name));
  }

  function load(name) {
    if (found.has(name)) return Promise.resolve(found.get(name));
    if (!waiting.has(name)) {
      const entry = {};
      entry.promise = new Promise((resolve, reject) => Object.assign(entry, { resolve, reject }));
      waiting.set(name, entry);
      const script = document.createElement("script");
      script.src = `data/${encodeURIComponent(name)}.js`;
      script.onerror = () => {
        waiting.delete(name);
        entry.reject(new Error(`data/${name}.js is missing: build the page again`));
      };
      document.head.append(script);
    }
    return waiting.get(name).promise;
  }

  /* What is there already, or undefined. */
  const ready = (name) => found.get(name);

  return { receive, load, ready };
})();
