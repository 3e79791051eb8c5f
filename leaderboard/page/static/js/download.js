"use strict";
/* What is on the screen as CSV, JSON and LaTeX. */
Spike4DGS.download = (() => {
  const { el, byId, heading } = Spike4DGS.dom;

  /* Return the columns and rows of the view as plain values, in the order of the screen. */
  function table(page, view, ranks) {
    const columns = ["rank_best", "rank_worst", "ties", "method", "label", ...view.columns.map((c) => c.id), "published", "scenes", "why"];
    const rows = view.shown.map((item) => {
      const rank = ranks?.get(item.index);
      return [rank?.best ?? null, rank?.worst ?? null, rank ? rank.ties().map((i) => view.board.rows[i].name).join(" ") : null,
        item.row.name, item.row.label, ...view.columns.map((c) => item.values[c.id]), item.published,
        view.scenes.map((s) => view.board.scenes[s].id).join(" "), item.row.why];
    });
    return { columns, rows };
  }

  /* Text that a spreadsheet would take for a formula gets an apostrophe. */
  function csvCell(value) {
    if (value === null) return "";
    if (typeof value === "number") return String(value);
    const text = /^[=+\-@\t\r]/.test(value) ? `'${value}` : value;
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  }

  const csv = ({ columns, rows }) => [columns, ...rows].map((row) => row.map(csvCell).join(",")).join("\n") + "\n";

  function json(page, view, state, data) {
    const rows = data.rows.map((row) => Object.fromEntries(data.columns.map((c, i) => [c, row[i]])));
    const facts = { board: view.board.id, release: page.release, metric: view.metric, scenes: view.scenes.map((s) => view.board.scenes[s]),
      hidden_rows: view.hidden.map((item) => item.row.name), bootstrap: { level: page.bootstrap.level, replicates: page.bootstrap.replicates },
      view: Spike4DGS.state.serialize(state) };
    return JSON.stringify({ ...facts, rows }, null, 1) + "\n";
  }

  const ESCAPES = { "\\": "\\textbackslash{}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}" };
  const tex = (text) => text.replace(/[\\~^&%$#_{}]/g, (c) => ESCAPES[c] ?? `\\${c}`);

  function latex(page, view, ranks) {
    const arrow = (c) => (c.higher ? "$\\uparrow$" : "$\\downarrow$");
    const head = ["Rank", "Method", ...view.columns.map((c) => `${tex(heading(c))} ${arrow(c)}`)];
    const lines = view.shown.map((item) => {
      const rank = ranks?.get(item.index);
      const shown = !rank ? "--" : rank.best === rank.worst ? String(rank.best) : `${rank.best}--${rank.worst}`;
      return [shown, tex(item.row.name), ...view.columns.map((c) => (item.values[c.id] === null ? "--" : item.values[c.id].toFixed(c.digits)))];
    });
    const rows = [head, ...lines].map((cells) => `${cells.join(" & ")} \\\\`);
    return [`% ${tex(view.board.name)}, ${view.scenes.length} scenes, ${view.hidden.length} rows hidden by filters`,
      `\\begin{tabular}{ll${"r".repeat(view.columns.length)}}`, "\\toprule", rows[0], "\\midrule", ...rows.slice(1), "\\bottomrule", "\\end{tabular}", ""].join("\n");
  }

  /* Return the text of a kind: csv, json or tex. */
  function text(kind, page, view, state, ranks) {
    const data = table(page, view, ranks);
    return kind === "csv" ? csv(data) : kind === "json" ? json(page, view, state, data) : latex(page, view, ranks);
  }

  function save(name, kind, content) {
    const type = { csv: "text/csv", json: "application/json", tex: "application/x-tex" }[kind];
    const link = el("a", { href: URL.createObjectURL(new Blob([content], { type })), download: `${name}.${kind}` });
    document.body.append(link);
    link.click();
    link.remove();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  }

  function buttons(page, view, state, ranks) {
    const name = `spike4dgs-${view.board.id.replace(/[^\w.+-]/g, "_")}-${view.metric}`;
    byId("below").prepend(el("p", { class: "downloads" }, "Download what is shown: ",
      [["csv", "CSV"], ["json", "JSON"], ["tex", "LaTeX"]].map(([kind, title]) =>
        el("button", { type: "button", "data-kind": kind, onclick: () => save(name, kind, text(kind, page, view, state, ranks)) }, title)),
      el("a", { href: `data/cells-${page.boards.indexOf(view.board)}.csv`, download: `${name}-cells.csv` }, "all cells as CSV")));
  }

  return { buttons, text };
})();
