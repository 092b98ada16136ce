// The run in progress, or one run while it is taken.
import { setLink, server } from "./app.js";
import { drawArray, drawFrame } from "./array.js";
import { bars, closeCharts, progressBar, stageBar } from "./charts.js";
import { clock, count, el, facts, localTime, panel, patch, percent, percentWithError, post, replace, runLink, runPath, statusPill, table, time, withError } from "./dom.js";
import { follow, oneSlot } from "./live.js";
import { axisName, drawTrend, meanText, measuredTiles, parameterCurve, scanCurve, tile, titleOf } from "./measured.js";

export async function showNow(main, _, asked) {
  const id = asked.get("run");
  const view = makeView(main);
  const query = id ? `?day=${encodeURIComponent(id.split("/")[0])}&name=${encodeURIComponent(id.split("/")[1] ?? "")}` : "";
  const onTheme = () => view.arrays();
  document.addEventListener("themechange", onTheme);
  addEventListener("resize", onTheme);
  const stop = follow(query, view.update, setLink);
  return () => { stop(); document.removeEventListener("themechange", onTheme); removeEventListener("resize", onTheme); };
}

function canvasFigure(title) {
  const canvas = el("canvas", { role: "img", "aria-label": title });
  const caption = el("figcaption", {}, title);
  return { canvas, caption, node: el("figure", {}, canvas, caption) };
}

function makeView(main) {
  const head = el("div.run-head"), alarms = el("div.alarms", { role: "status", "aria-live": "polite" }), tiles = el("div.tiles");
  const frame = canvasFigure("Last frame"), before = canvasFigure("Before the last cycle"), after = canvasFigure("After it");
  const trends = el("div.trends");
  const losses = el("div"), stages = el("div"), readings = el("div"), log = el("div"), choice = el("div.choice");
  const lossPanel = panel("Losses by cause", { class: "losses" }, losses);
  const grid = el("div.grid", {},
    panel("Last shot", { class: "arrays", aside: choice }, el("div.figures.last", {}, frame.node, before.node, after.node)),
    el("div.side", {}, trends, lossPanel),
    panel("Stages against their budgets", { class: "stages" }, stages),
    el("div.stack", {}, panel("Readings and interlocks", {}, readings), panel("Events", {}, log)));
  let charts = new Map(), latest = null, picked = null, bitmap = null, reduced = 1, isBuilt = false;
  const load = oneSlot((image, factor) => { bitmap = image; reduced = factor; arrays(); });

  function build() {
    replace(main, head, alarms, tiles, grid);
    isBuilt = true;
  }

  function update(state) {
    latest = state;
    if (!state.run) {
      isBuilt = false;
      replace(main, alarmList(state.alarms), state.error ? null : el("p.hint", {}, "There is no run yet. Start one with ",
        el("code", {}, "labseq run"), ": it appears here by itself."));
      return;
    }
    if (!isBuilt) build();
    const { run, figures } = state;
    document.title = `${run.status === "running" ? `${run.n_done}/${run.n_shots}` : run.status} ${run.name} · labseq`;
    patch(head, headOf(run, state));
    patch(alarms, alarmList(state.alarms));
    patch(tiles, tilesOf(run, figures, state.measured, state.scan));
    trendsOf(state);
    lossPanel.hidden = !state.losses.length;
    patch(losses, bars(state.losses.map((one) => ({ name: one.cause, value: one.mean, text: withError(one.mean, one.error ?? 0) })), "Atoms lost in a shot"),
      el("p.note", {}, "atoms in a shot, known in simulations"));
    patch(stages, stageTable(state.stages, run.simulated));
    patch(readings, readingsOf(state));
    patch(log, el("ul.events", { tabindex: "0" }, [...state.log].reverse().map((line) => el("li", {}, el("time", { dateTime: line.t_utc }, localTime(line.t_utc, false)), " ", line.text))));
    shotOf(state);
  }

  // What is measured against the scanned value first, then by shot.
  function trendsOf({ run, measured, scan }) {
    const hasCurve = Boolean(scan?.points?.length && scan.quantities.length && (!scan.is_map || scan.quantities[0].fits.length));
    const names = [...(hasCurve ? [""] : []), ...measured.filter((one) => one.trend.length).map((one) => one.name)];
    if (String([run.id, ...names]) !== trends.names) {
      trends.names = String([run.id, ...names]);
      closeCharts();
      charts = new Map(names.map((name) => [name, name === "" ? (scan.is_map ? parameterCurve() : scanCurve()) : { node: el("div.chart") }]));
      replace(trends, [...charts].map(([name, chart]) => panel(name === "" ? `${scan.is_map ? "Fits of " : ""}${titleOf(scan.quantities[0])} by ${axisName(scan.axes[0])}` : titleOf(measured.find((one) => one.name === name)), { class: "trend" }, chart.node)));
    }
    if (hasCurve) charts.get("").draw(scan, 0, chartHeight);
    for (const one of measured) if (charts.has(one.name)) drawTrend(charts.get(one.name).node, one, { height: chartHeight });
  }

  function shotOf(state) {
    const shot = state.shot;
    if (!shot || !shot.images.length) { bitmap = null; arrays(); return; }
    const withFrame = shot.images.map((one, i) => (one.has_frame ? i : -1)).filter((i) => i >= 0).pop();
    if (withFrame === undefined) bitmap = null;
    else load(`/api/v1/runs/${runPath(state.run.id)}/shots/${shot.shot}/frames/${withFrame}.png?width=1024${shot.status === "complete" ? "" : `&attempt=${shot.attempt}`}`);
    const n = shot.cycles.length;
    if (picked !== null && picked >= n) picked = null;
    patch(choice, el("a", { href: `/runs/${runPath(state.run.id)}/shots/${shot.shot}` }, `shot ${shot.shot}`), shot.point ? el("span.note", {}, shot.point) : null,
      n > 1 ? el("label", {}, "cycle ", el("select", { "aria-label": "Cycle", onchange: (event) => { picked = event.target.value === "" ? null : Number(event.target.value); arrays(); } },
        el("option", { value: "", selected: picked === null }, "last"), shot.cycles.map((_, i) => el("option", { value: i, selected: picked === i }, String(i))))) : null);
    arrays();
  }

  function arrays() {
    const { run, shot } = latest ?? {};
    if (!run || !isBuilt) return;
    const images = shot ? shot.images : [];
    const cycle = shot ? shot.cycles[picked ?? shot.cycles.length - 1] : null;
    const at = cycle ? images.findIndex((one) => one.step === cycle.step && one.cycle === cycle.cycle) : images.length - 1;
    const last = images[images.length - 1], end = images[at < 0 ? images.length - 1 : at], start = cycle ? images[Math.max(0, at - 1)] : images[0];
    frame.node.hidden = !bitmap;  // before it is drawn: what is hidden has no width
    drawFrame(frame.canvas, bitmap, reduced, shot?.sites_px ?? null, last?.occupancy ?? []);
    frame.caption.textContent = last ? `Last frame: ${last.name}, ${count(last.n_atoms, "atom")}` : "";
    if (!end) { before.node.hidden = after.node.hidden = true; return; }
    before.node.hidden = !cycle;
    after.node.hidden = false;
    const caption = (image) => `${count(image.n_atoms, "atom")}${run.target.n_atoms ? `, ${count(image.n_defects, "defect")}` : ""}${image.n_surplus ? `, ${image.n_surplus} surplus` : ""}`;
    if (cycle) {
      const moves = cycle.batches.slice(0, cycle.n_batches_played);
      drawArray(before.canvas, run.lattice, run.target.fill, start.occupancy, moves);
      before.caption.textContent = `Before cycle ${cycle.cycle}: ${caption(start)}; ${count(moves.flat().length, "move")} in ${moves.length === 1 ? "1 batch" : `${moves.length} batches`}`;
      before.canvas.setAttribute("aria-label", before.caption.textContent);
    }
    drawArray(after.canvas, run.lattice, run.target.fill, end.occupancy);
    after.caption.textContent = `${cycle ? `After cycle ${cycle.cycle}` : end.name}: ${caption(end)}`;
    after.canvas.setAttribute("aria-label", after.caption.textContent);
  }
  return { update, arrays };
}

const chartHeight = () => (document.documentElement.classList.contains("wall") ? Math.round(innerHeight * 0.2) : 180);

export function headOf(run, state) {
  const others = (state.running ?? []).filter((id) => id !== run.id);
  const left = run.time_left_s !== null && run.time_left_s !== undefined ? `${clock(run.time_left_s)} left` : "";
  return [
    el("div.title-line", {}, el("h1", {}, run.name), statusPill(run.status), el("span", {}, run.simulated ? el("span.tag", {}, "simulated") : null, run.tags.map((tag) => el("span.tag", {}, tag))), stopButton(run)),
    el("div.sub-line", {}, runLink(run.id), el("span", {}, `profile ${run.profile}`), el("span", {}, `started ${localTime(run.started_utc)}`), el("span", {}, `seed ${run.seed}`),
      others.map((id) => el("a", { href: `/now?run=${encodeURIComponent(id)}` }, `also in progress: ${id}`))),
    el("div.progress-line", {}, progressBar(run.n_done, run.n_shots),
      el("span.progress-text", {}, el("strong", {}, String(run.n_done)), ` of ${count(run.n_shots, "shot")}`, left ? el("span.left", {}, left) : null)),
    run.comment ? el("p.comment", {}, run.comment) : null,
  ];
}

function stopButton(run) {
  if (run.is_stopping) return el("span.tag", {}, "ends after this shot");
  if (!server.may_act || run.status !== "running") return null;
  return el("button", { type: "button", onclick: async () => {
    if (!confirm("End this run after its current shot?")) return;
    try { await post(`/runs/${runPath(run.id)}/stop`, {}); } catch (error) { alert(error.message); }
  } }, "Stop after this shot");
}

export function alarmList(alarms) {
  return alarms.map((one) => el("div.alarm", { class: `is-${one.level}` }, el("strong", {}, one.level === "error" ? "✕ " : "! ", one.title), one.text ? el("span", {}, one.text) : null));
}

export function tilesOf(run, figures, measured, scan) {
  const [low, high] = figures.defect_free_interval, hasTarget = measured.some((one) => one.name === "defect_free");
  const filling = measured.find((one) => one.name === "filling");  // also of shots that are not judged
  return [
    ...measuredTiles(measured, scan),
    ...(hasTarget ? [
      tile("Defect-free", figures.n_judged ? percent(figures.defect_free) : "–", figures.n_judged ? `${figures.n_defect_free} of ${figures.n_judged}, ${(100 * low).toFixed(0)} to ${(100 * high).toFixed(0)} %` : "no judged shot", "is-green"),
      tile("Filling", figures.n_judged || !filling ? percentWithError(figures.filling, figures.filling_interval) : meanText(filling, filling), `${count(run.target.n_atoms, "site")}, ${run.target.name}`, "is-blue"),
      tile("Seen defect-free", run.n_done ? percent(figures.n_seen / run.n_done) : "–", `${figures.n_seen} of ${run.n_done}, in some image`),
    ] : []),
    hasTarget || figures.cycles ? tile("Cycles", figures.cycles === null ? "–" : figures.cycles.toFixed(1), "mean of a shot") : null,
    tile("Shot", time(figures.shot_s), "mean, all steps"),
    tile("Failed attempts", String(run.n_attempts), run.n_attempts ? "see alarms" : "none", run.n_attempts ? "is-warn" : ""),
  ];
}

export function stageTable(stages, simulated) {
  if (!stages.length) return el("p.hint", {}, "no shot has been read yet");
  const heads = ["stage", simulated ? "host" : "median", "p99", simulated ? "modelled" : null, "budget", "", "over"].filter((one) => one !== null)
    .map((text, i) => ({ text, right: i > 0 && text !== "" }));
  const rows = stages.map((one) => ({ mark: one.n_over ? "is-over" : "", cells: [
    el("span", { class: one.is_step ? "is-step" : "" }, one.stage), time(one.median_s), time(one.p99_s), ...(simulated ? [time(one.modelled_s)] : []),
    one.budget_s ? time(one.budget_s) : "–", stageBar(one), one.n_over ? `${one.n_over} of ${one.n}` : "" ] }));
  return table(heads, rows, { label: "Stages" });
}

function readingsOf(state) {
  const values = state.shot?.readings ?? {};
  const failed = state.alarms.filter((one) => /interlock/i.test(`${one.title} ${one.text}`));
  const parts = [];
  if (failed.length) parts.push(alarmList(failed));
  else parts.push(el("p.note", {}, el("span.ok", { "aria-hidden": "true" }, "✓ "), "no interlock has stopped a shot"));
  if (Object.keys(values).length) parts.push(facts(values));
  else parts.push(el("p.hint", {}, "the last shot has no readings"));
  return parts;
}
