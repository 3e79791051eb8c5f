"use strict";
/* Elements from plain values. Text is always a text node: nothing that an entry holds is parsed as HTML. */
Spike4DGS.dom = (() => {
  /* Return an element. Attributes that are null or false are left out, functions are listeners ("onclick"). */
  function el(tag, attributes = {}, ...children) {
    const node = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) {
      if (typeof value === "function") node.addEventListener(key.slice(2), value);
      else if (key === "checked" || key === "value" || key === "selected") node[key] = value;
      else if (value !== null && value !== false && value !== undefined) node.setAttribute(key, value === true ? "" : value);
    }
    node.append(...children.flat(Infinity).filter((c) => c !== null && c !== undefined && c !== false));
    return node;
  }

  const byId = (id) => document.getElementById(id);

  const fill = (node, ...children) => {
    node.replaceChildren(...children.flat(Infinity).filter(Boolean));
    return node;
  };

  /* Return a number as people read it; a dash where there is none. */
  function format(metric, value) {
    return value === null || value === undefined ? "–" : value.toFixed(metric.digits);
  }

  const heading = (metric) => (metric.unit ? `${metric.title}, ${metric.unit}` : metric.title);

  const plural = (n, word) => `${n} ${word}${n === 1 ? "" : "s"}`;

  return { el, byId, fill, format, heading, plural };
})();
