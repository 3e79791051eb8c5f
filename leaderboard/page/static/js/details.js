"use strict";
/* What a doubting reader asks of a row: commands, hashes, environments, commits, and each cell's values. */
Spike4DGS.details = (() => {
  const { el, byId, fill, format, heading } = Spike4DGS.dom;

  async function draw(page, state, view, close) {
    const dialog = byId("details");
    const index = view.board.rows.findIndex((row) => row.name === state.row);
    if (!state.row || index < 0) {
      if (dialog.open) dialog.close();
      return;
    }
    const all = await Spike4DGS.load(`details-${page.boards.indexOf(view.board)}`);
    const row = view.board.rows[index];
    const found = all[index];
    fill(dialog,
      el("div", { class: "dialog-head" }, el("h2", { id: "details-title" }, row.name), el("button", { type: "button", onclick: close }, "Close")),
      facts(row, found),
      cells(page, view, row),
      found.records.map((record) => recordOf(record, found.records.length > 1)),
      el("details", {}, el("summary", {}, "Parameters"), code(JSON.stringify(found.params, null, 1))),
      found.trainedOn.length ? el("details", {}, el("summary", {}, `Trained on ${found.trainedOn.length} data sets`), code(found.trainedOn.join("\n"))) : null);
    dialog.onclose = close;
    if (!dialog.open) dialog.showModal();
  }

  const code = (text) => el("pre", { tabindex: "0" }, text);

  function list(pairs) {
    return el("dl", {}, pairs.filter(([, value]) => value !== null && value !== "").map(([key, value]) => [el("dt", {}, key), el("dd", {}, String(value))]));
  }

  function facts(row, found) {
    return list([
      ["Method", `${row.method}${found.version ? `, version ${found.version}` : ""}`],
      ["Parts", Object.entries(row.parts).map(([k, v]) => `${k}: ${v}`).join(", ")],
      ["Given", row.given.join(", ") || "streams, clock and intrinsics only"],
      ["Verified", Spike4DGS.table.labelOf(row)],
      ["Why no rank", row.why],
      ["Run", found.run],
      ...found.entries.map((e) => ["Entry", `${e.path}, submitted ${e.submitted}, sha256 ${e.sha256}`]),
      ...found.verified.filter((v) => v.by).map((v) => ["Scored again", `${v.by.when}, ${harness(v.by.harness)}, ${v.by.environment.cpu}`]),
      ...found.verified.filter((v) => v.unverified.length).map((v) => ["As claimed", v.unverified.join(", ")]),
    ]);
  }

  const harness = (h) => (h ? `${h.version}, ${h.commit ? `commit ${h.commit}${h.dirty ? " with changes" : ""}` : "no commit"}` : "not stated");

  function cells(page, view, row) {
    const columns = view.columns;
    return el("div", { class: "wide", tabindex: "0", role: "region", "aria-label": "Scores by scene" }, el("table", {},
      el("caption", {}, "By scene", row.seeds.length > 1 ? `, means of the seeds ${row.seeds.join(", ")}` : ""),
      el("thead", {}, el("tr", {}, el("th", { scope: "col" }, "Scene"), columns.map((c) => el("th", { scope: "col", class: "number" }, heading(c))))),
      el("tbody", {}, view.board.scenes.map((scene, s) => el("tr", {}, el("th", { scope: "row" }, scene.id),
        row.cells[s].why ? el("td", { colspan: String(columns.length) }, row.cells[s].why)
          : columns.map((c) => el("td", { class: "number" }, format(c, row.cells[s].v[c.number]))))))));
  }

  function recordOf(record, named) {
    const scenes = Object.entries(record.cells);
    const title = named ? `Seed ${record.seed ?? 0}` : "Record";
    return el("section", { "aria-label": title }, el("h3", {}, title),
      el("p", {}, "Command"), code(record.command),
      list([["Written", record.created], ["Seed", record.seed], ["Code", harness(record.harness)]]),
      el("p", {}, "Predictions, sha256 of SHA256SUMS"),
      code(scenes.map(([scene, cell]) => `${cell.predictions_sha256 ?? cell.status}  ${scene}  ${cell.device ?? ""}  budget ${cell.budget ?? "not stated"}`).join("\n")),
      el("details", {}, el("summary", {}, "Environment"), code(JSON.stringify(record.environment, null, 1))),
      el("details", {}, el("summary", {}, "Cells"), code(JSON.stringify(record.cells, null, 1))));
  }

  return { draw };
})();
