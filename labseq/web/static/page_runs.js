// The list of runs, one run, and two runs side by side.
import { go, server } from "./app.js";
import { positions } from "./array.js";
import { bars, siteMap } from "./charts.js";
import { count, el, facts, failure, getJson, localTime, panel, patch, percent, percentWithError, post, replace, runLink, runPath, statusPill, table, time, withError } from "./dom.js";
import { axisName, drawTrend, isOfTarget, meanText, parameterCurve, scanCurve, titleOf, valueText } from "./measured.js";
import { headOf, stageTable, tilesOf } from "./page_now.js";
import { scanOfRun } from "./page_scan.js";

const PAGE = 50;

export async function showRuns(main, _, asked) {
  const text = el("input", { type: "search", value: asked.get("q") ?? "", placeholder: "date, name, profile, outcome, scan, result, comment, tag", "aria-label": "Search the runs" });
  const status = el("select", { "aria-label": "Status" }, ["", "running", "complete", "stopped", "failed", "damaged"].map((one) => el("option", { value: one, selected: one === (asked.get("status") ?? "") }, one || "any status")));
  const found = el("div"), note = el("span.note", { role: "status" });
  const chosen = new Set();
  const compare = el("button", { type: "button", disabled: true, onclick: () => { const [a, b] = chosen; go(`/compare?a=${encodeURIComponent(a)}&b=${encodeURIComponent(b)}`); } }, "Compare two");
  let first = Number(asked.get("first") ?? 0), timer = null;

  async function load() {
    const query = new URLSearchParams({ q: text.value, status: status.value, first, n: PAGE });
    try {
      const answer = await getJson(`/runs?${query}`);
      history.replaceState(null, "", `/runs?${new URLSearchParams([...query].filter(([key, value]) => value && key !== "n" && value !== "0"))}`.replace(/\?$/, ""));
      const unread = answer.n_unread ? `; ${count(answer.n_unread, "run")} not read yet` : "";
      note.textContent = `${answer.n_found} of ${count(answer.n_runs, "run")}${unread}`;
      patch(found, answer.runs.length ? listOf(answer.runs) : el("p.hint", {}, answer.n_runs ? "No run has these words." : "There are no runs in this data folder yet."), pages(answer.n_found));
    } catch (error) { patch(found, failure(error)); }
  }
  function listOf(runs) {
    const heads = ["", "run", { text: "started", line: true }, "profile", { text: "shots", right: true }, "status", "scanned", "measured", { text: "defect-free", right: true }, { text: "filling", right: true }, "comment"];
    return table(heads, () => runs.map((run) => [
      el("input", { type: "checkbox", checked: chosen.has(run.id), "aria-label": `Choose ${run.id} to compare`, onchange: (event) => { event.target.checked ? chosen.add(run.id) : chosen.delete(run.id); compare.disabled = chosen.size !== 2; } }),
      runLink(run.id), localTime(run.started_utc), run.profile, run.n_shots === null ? "–" : `${run.n_done} of ${run.n_shots}`,
      [statusPill(run.status), run.simulated ? el("span.tag", {}, "simulated") : null, run.has_scan ? el("span.tag", {}, "scan") : null].filter(Boolean),
      run.scanned || "–", resultsOf(run).join(", ") || "–",
      percent(run.defect_free), percentWithError(run.filling, run.filling_interval),
      [run.tags.map((tag) => el("span.tag", {}, tag)), " ", run.comment.slice(0, 120), run.error ? el("small.reason", {}, run.error) : null].filter(Boolean),
    ].map((cell) => (Array.isArray(cell) ? el("span", {}, cell) : cell))), { label: "Runs" });
  }
  // Of a run in progress, means: its fits are on its page.
  function resultsOf(run) {
    const own = (listed) => listed.filter((one) => !isOfTarget(one));
    return run.results.length ? own(run.results).map((one) => one.text) : own(run.measured).map((one) => `${one.title} ${meanText(one, one)}`);
  }
  function pages(n) {
    if (n <= PAGE) return null;
    const move = (by) => () => { first = Math.max(0, first + by); load(); scrollTo(0, 0); };
    return el("div.pages", {}, el("button", { type: "button", disabled: first === 0, onclick: move(-PAGE) }, "Newer"), el("span.note", {}, `${first + 1} to ${Math.min(n, first + PAGE)}`), el("button", { type: "button", disabled: first + PAGE >= n, onclick: move(PAGE) }, "Older"));
  }
  const later = () => { clearTimeout(timer); timer = setTimeout(() => { first = 0; load(); }, 200); };
  text.addEventListener("input", later);
  status.addEventListener("change", later);
  replace(main, el("div.title-line", {}, el("h1", {}, "Runs"), note), el("div.tools", { role: "search" }, text, status, compare), found);
  await load();
  const again = setInterval(() => { if (!document.hidden && first === 0) load(); }, 5000);
  return () => { clearInterval(again); clearTimeout(timer); };
}

export async function showRun(main, [day, name]) {
  const id = `${day}/${name}`, values = await getJson(`/runs/${runPath(id)}`);
  const { run } = values;
  document.title = `${run.name} · labseq`;
  const tiles = el("div.tiles"), trends = values.measured.filter((one) => one.trend.length).map((one) => [one, el("div.chart")]), more = el("div.grid"), shots = el("div"), map = el("div"), scan = el("div.grid");
  replace(main, el("div.run-head", {}, headOf(run, {}), el("div.links", {}, run.status === "running" ? el("a", { href: `/now?run=${encodeURIComponent(id)}` }, "watch it") : null,
    values.has_scan ? el("a", { href: `/scan?run=${encodeURIComponent(id)}` }, "its scan") : null, values.files.map((kind) => el("a", { href: `/api/v1/runs/${runPath(id)}/files/${kind}` }, kind)), el("a", { href: `/api/v1/runs/${runPath(id)}` }, "as JSON"))),
    run.error ? el("div.alarm.is-error", {}, el("strong", {}, run.status), el("span", {}, run.error)) : null,
    values.n_damaged_lines ? el("div.alarm.is-warning", {}, el("strong", {}, `${count(values.n_damaged_lines, "line")} of the index cannot be read`)) : null,
    tiles, scan, el("div.grid", {}, trends.map(([one, box]) => panel(titleOf(one), { class: "half" }, box))), more,
    el("div.grid", {}, panel("Shots", { class: "wide" }, shots), panel("Map of the sites", { class: "half" }, map), panel("Changed by the command line", { class: "half" }, orNone(values.changes)), notesPanel(run),
      panel("Calibrations", { class: "half" }, orNone(values.calibrations)), panel("Devices", { class: "half" }, Object.entries(values.devices).map(([device, about]) => el("details", {}, el("summary", {}, device, about.model ? `: ${about.model}` : ""), typeof about === "object" ? facts(about) : about))),
      panel("Where it came from", { class: "wide" }, el("details", {}, el("summary", {}, `labseq ${values.provenance.labseq ?? "?"} on ${values.provenance.host ?? "?"}`), facts({ ...values.provenance, plugins: values.plugins.map((one) => `${one.name} ${one.version}`).join(", ") })))));
  patch(tiles, tilesOf(run, values.figures, values.measured, null));
  for (const [one, box] of trends) drawTrend(box, one);
  fillLater(id, values, more, scan, tiles);
  mapOfSites(map, run);
  await shotTable(shots, id);
}

async function fillLater(id, values, more, scan, tiles) {
  try {
    if (values.has_scan) patch(tiles, tilesOf(values.run, values.figures, values.measured, await scanOfRun(scan, id)));
    const { statistics, stages, n_read, n_shots } = await getJson(`/runs/${runPath(id)}/statistics`);
    const part = n_read < n_shots ? `from ${n_read} of ${n_shots} shots` : `from all ${count(n_shots, "shot")}`;
    const each = (one, factor = 1) => withError(one.mean === null ? null : factor * one.mean, factor * (one.error ?? 0));
    replace(more,
      statistics.cycles.length ? panel(`Cycles, ${part}`, { class: "half" }, table(["cycle", ...["shots", "defect-free", "seen", "filling", "moves", "batches", "left out"].map((text) => ({ text, right: true }))],
        statistics.cycles.map((one) => [String(one.cycle), String(one.n_shots), percent(one.defect_free.rate), percent(one.seen.rate), one.filling.mean === null ? "–" : `${each(one.filling, 100)} %`, each(one.n_atom_moves), each(one.n_batches), each(one.n_left_out)]), { label: "Cycles" })) : null,
      statistics.defects.length ? panel(`Defects at the end, ${part}`, { class: "half" }, bars(statistics.defects.slice(0, 13).map((n, defects) => ({ name: String(defects), value: n, text: count(n, "shot") })), "Shots by number of defects")) : null,
      values.losses.length ? panel("Losses by cause", { class: "half" }, bars(values.losses.map((one) => ({ name: one.cause, value: one.mean, text: withError(one.mean, one.error ?? 0) })), "Atoms lost in a shot")) : null,
      panel("Stages", { class: "half" }, stageTable(stages, values.run.simulated)));
  } catch (error) { replace(more, failure(error)); }
}

async function mapOfSites(box, run, quantity = "") {
  try {
    const found = await getJson(`/runs/${runPath(run.id)}/map?${new URLSearchParams({ quantity })}`), { cols } = run.lattice;
    const values = found.values.flat(), trials = found.n_trials.flat(), known = values.filter((value) => value !== null);
    const text = (i) => `site (${Math.floor(i / cols)}, ${i % cols}): ${values[i] === null ? "too few" : percent(values[i])} of ${trials[i]}`;
    const range = known.length ? `from ${percent(Math.min(...known))} (yellow) to ${percent(Math.max(...known))} (blue), mean ${percent(found.mean)}` : "no site has 5 trials yet";
    replace(box, el("label", {}, "Quantity ", el("select", { "aria-label": "Quantity of the map", onchange: (event) => mapOfSites(box, run, event.target.value) },
      found.choices.map((name) => el("option", { value: name, selected: name === found.quantity }, name)))),
    siteMap(positions(run.lattice), values, text, `Map of ${found.quantity}`), el("p.note", {}, `${range}; ${count(found.n_read, "shot")} read of ${found.n_shots}`));
  } catch (error) { replace(box, failure(error)); }
}

function orNone(values) { return Object.keys(values).length ? facts(values) : el("p.hint", {}, "none"); }

async function shotTable(box, id, first = 0) {
  const { shots, n_lines, scanned, measured } = await getJson(`/runs/${runPath(id)}/shots?first=${first}&n=${PAGE}`);
  if (!n_lines) { replace(box, el("p.hint", {}, "no shot yet")); return; }
  const own = measured.map((one, i) => [one, i]).filter(([one]) => !isOfTarget(one)), hasTarget = own.length < measured.length;
  const numbers = [...scanned, ...own.map(([one]) => one.title), ...(hasTarget ? ["defects", "filling", "seen after cycle", "cycles", "batches", "moves"] : []), "time"];
  const heads = [{ text: "shot", right: true }, "outcome", ...numbers.map((text) => ({ text, right: true }))];
  const rows = shots.map((one) => [el("a", { href: `/runs/${runPath(id)}/shots/${one.shot}${one.counts ? "" : `?attempt=${one.attempt}`}` }, String(one.shot)), outcomeOf(one),
    ...one.scanned, ...own.map(([quantity, i]) => valueText(quantity, one.measured[i])),
    ...(hasTarget ? [one.n_defects ?? "–", percent(one.filling, 2), one.seen >= 0 ? one.seen : "–", one.n_cycles, one.n_batches, one.n_atom_moves].map(String) : []), time(one.duration_s)]);
  replace(box, table(heads, rows, { label: "Shots" }), n_lines > PAGE ? el("div.pages", {},
    el("button", { type: "button", disabled: first === 0, onclick: () => shotTable(box, id, Math.max(0, first - PAGE)) }, "Later"),
    el("span.note", {}, `${first + 1} to ${Math.min(n_lines, first + PAGE)} of ${n_lines}, the newest first`),
    el("button", { type: "button", disabled: first + PAGE >= n_lines, onclick: () => shotTable(box, id, first + PAGE) }, "Earlier")) : null);
}

function outcomeOf(shot) {
  if (!shot.counts) return `attempt ${shot.attempt}, does not count`;
  return shot.success === 1 ? "defect-free" : shot.filling === null ? "not judged" : "defects";
}

function notesPanel(run) {
  if (!server.may_act) return panel("Comment", { class: "half" }, run.comment || run.tags.length ? [el("p.comment", {}, run.comment), run.tags.map((tag) => el("span.tag", {}, tag))] : el("p.hint", {}, "none"));
  const comment = el("textarea", { rows: 3, value: run.comment, "aria-label": "Comment" }), tags = el("input", { value: run.tags.join(", "), "aria-label": "Tags, separated by commas", placeholder: "tags, separated by commas" });
  const note = el("span.note", { role: "status" });
  const keep = async () => {
    try { await post(`/runs/${runPath(run.id)}/notes`, { comment: comment.value, tags: tags.value.split(",") }); note.textContent = "saved"; } catch (error) { note.textContent = error.message; }
  };
  return panel("Comment", { class: "half" }, el("div.form", {}, comment, tags, el("div", {}, el("button", { type: "button", onclick: keep }, "Keep"), " ", note)));
}

export async function showCompare(main, _, asked) {
  const ids = [asked.get("a") ?? "", asked.get("b") ?? ""];
  const runs = await Promise.all(ids.map((id) => getJson(`/runs/${runPath(id)}`)));
  const texts = await Promise.all(ids.map(async (id) => { const answer = await fetch(`/api/v1/runs/${runPath(id)}/files/sequence`); return answer.ok ? answer.text() : ""; }));
  const scans = await Promise.all(runs.map((r) => (r.has_scan ? getJson(`/runs/${runPath(r.run.id)}/scan`) : null)));
  const names = [...new Set(runs.flatMap((r) => r.measured.map((one) => one.name)))];
  const ofRun = (r, name) => r.measured.find((one) => one.name === name);
  const rows = [["profile", (r) => r.run.profile], ["status", (r) => r.run.status], ["shots", (r) => `${r.run.n_done} of ${r.run.n_shots}`],
    ...names.map((name) => [name, (r) => (ofRun(r, name) ? meanText(ofRun(r, name), ofRun(r, name)) : "–")]), ...parametersOf(scans),
    ["cycles", (r) => r.figures.cycles?.toFixed(2) ?? "–"], ["time of a shot", (r) => time(r.figures.shot_s)], ["seed", (r) => r.run.seed],
    ["changed", (r) => Object.entries(r.changes).map(([k, v]) => `${k} = ${v}`).join(", ") || "nothing"], ["calibrations", (r) => Object.entries(r.calibrations).map(([k, v]) => `${k} ${v}`).join(", ") || "none"], ["comment", (r) => r.run.comment || "–"]];
  const charts = names.flatMap((name) => runs.map((r, i) => ({ name, r, scan: scanWith(scans[i], name), trend: ofRun(r, name), box: el("div.chart") }))).filter((one) => one.scan || one.trend?.trend.length);
  for (const one of charts) if (one.scan) one.curve = one.scan.is_map ? parameterCurve() : scanCurve();
  replace(main, el("h1", {}, "Two runs"), table(["", ...runs.map((r) => r.run.id)], rows.map(([name, of]) => ({ mark: of(runs[0], 0) === of(runs[1], 1) ? "" : "is-other", cells: [name, of(runs[0], 0), of(runs[1], 1)] })), { label: "Figures of both runs" }),
    el("div.sub-line", {}, runs.map((r) => runLink(r.run.id))),
    el("div.grid", {}, charts.map((one) => panel(`${titleOf(one.trend ?? { name: one.name, title: one.name })}${one.scan ? ` by ${axisName(one.scan.axes[0])}` : ""}: ${one.r.run.id}`, { class: "half" }, one.curve?.node ?? one.box)),
      panel("Lines of the sequences that differ", { class: "wide" }, differences(texts))));
  for (const { name, scan, trend, box, curve } of charts) {
    if (curve) curve.draw(scan, placeIn(scan, name), () => 200, { more: { fixed: rangeOf(charts.filter((one) => one.name === name && one.scan).flatMap((one) => one.scan.points.map((point) => point.values[placeIn(one.scan, name)]))) } });
    else drawTrend(box, trend, { fixed: rangeOf(runs.flatMap((r) => ofRun(r, name)?.trend ?? [])) });
  }
}

const placeIn = (scan, name) => scan.quantities.findIndex((one) => one.name === name);
// The scan if it has points with this quantity that a chart can show
const scanWith = (scan, name) => (scan?.points?.length && placeIn(scan, name) >= 0 && (!scan.is_map || scan.quantities[placeIn(scan, name)].fits.length) ? scan : null);

// A row for each parameter of the fits of either run
function parametersOf(scans) {
  const fits = scans.map((scan) => (scan?.quantities ?? []).flatMap((one) => one.fits).filter((fit) => !fit.error));
  const names = [...new Set(fits.flat().flatMap((fit) => Object.entries(fit.parameters).filter(([, one]) => one.error).map(([name]) => name)))];
  const text = (fit, name) => (fit.at.length ? `${fit.parameters[name].text} at ${fit.at.join(", ")}` : fit.parameters[name].text);
  return names.map((name) => [name, (_, i) => fits[i].filter((fit) => fit.parameters[name]).map((fit) => text(fit, name)).join("; ") || "–"]);
}

// The same range for both runs
function rangeOf(means) {
  const ends = means.flatMap((mean) => [mean.value, ...mean.interval]).filter((value) => value !== null);
  if (!ends.length) return [0, 1];
  const low = Math.min(...ends), high = Math.max(...ends), pad = 0.05 * (high - low || Math.abs(high) || 1);
  return [low - pad, high + pad];
}

function differences([a, b]) {
  const [left, right] = [a.split("\n"), b.split("\n")];
  const only = (these, those) => these.filter((line) => line.trim() && !those.includes(line));
  const first = only(left, right), second = only(right, left);
  if (!first.length && !second.length) return el("p.hint", {}, "The sequences are the same.");
  return el("div.two", {}, el("pre", { tabindex: "0" }, first.join("\n")), el("pre", { tabindex: "0" }, second.join("\n")));
}
