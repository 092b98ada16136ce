// The scan of the newest run, or of one run, as it fills.
import { setLink } from "./app.js";
import { closeCharts, curve, DEFECT_FREE, FILLING, heatMap } from "./charts.js";
import { el, getJson, panel, percent, percentWithError, replace, runPath, table } from "./dom.js";
import { follow } from "./live.js";
import { alarmList, headOf } from "./page_now.js";

export async function showScan(main, _, asked) {
  const id = asked.get("run");
  const query = id ? `?day=${encodeURIComponent(id.split("/")[0])}&name=${encodeURIComponent(id.split("/")[1] ?? "")}` : "";
  const head = el("div.run-head"), body = el("div.grid");
  let shape = "";
  const draw = (state) => {
    if (!state.run) { replace(main, alarmList(state.alarms), el("p.hint", {}, "There is no run yet.")); shape = ""; return; }
    const next = JSON.stringify([state.run.id, state.scan?.axes?.map((axis) => axis.words), state.scan?.is_map]);
    if (next !== shape) { closeCharts(); body.replaceChildren(); body.parts = null; replace(main, head, body); }
    shape = next;
    replace(head, headOf(state.run, state));
    document.title = `Scan ${state.run.name} · labseq`;
    drawScan(body, state.scan);
  };
  return follow(query, draw, setLink);
}

export async function scanOfRun(body, id) { drawScan(body, await getJson(`/runs/${runPath(id)}/scan`)); }

const FIGURES = [["filling", { ...FILLING, label: "Filling" }], ["defect_free", { ...DEFECT_FREE, label: "Defect-free" }]];

function drawScan(body, scan) {
  if (!scan) { replace(body, panel("Scan", { class: "wide" }, el("p.hint", {}, "This run scans nothing. "), el("p.hint", {}, el("a", { href: "/runs?q=" }, "Runs with a scan")))); return; }
  if (scan.error) { replace(body, el("div.alarm.is-error", {}, el("strong", {}, "The scan cannot be shown"), el("span", {}, scan.error))); return; }
  if (!scan.points.length) { replace(body, panel("Scan", { class: "wide" }, el("p.hint", {}, "No point has a shot yet."))); return; }
  const parts = body.parts ??= makeParts(body, scan);
  if (scan.visits) drawVisits(parts, scan);
  if (scan.is_map) drawMaps(parts, scan);
  else drawCurves(parts, scan);
  replace(parts.table, pointTable(scan));
}

function makeParts(body, scan) {
  const parts = { visits: el("div.chart"), best: el("div"), table: el("div"), maps: el("div.maps"), curves: [] };
  const panels = [];
  if (scan.visits) panels.push(panel(`${scan.figure}: points in the order they were tried`, { class: "half" }, parts.visits), panel("Best so far", { class: "half" }, parts.best));
  if (scan.is_map) panels.push(panel("Map", { class: "wide" }, parts.maps));
  else
    for (const axis of scan.axes)
      for (const [name, options] of FIGURES) {
        const box = el("div.chart");
        parts.curves.push(box);
        panels.push(panel(`${options.label} by ${shortName(axis.address)}`, { class: "half" }, box));
      }
  panels.push(panel("Points", { class: "wide" }, parts.table));
  replace(body, panels);
  return parts;
}

const shortName = (address) => address.split(" with ").map((one) => one.split(".").pop()).join(" with ");

function drawCurves(parts, scan) {
  let box = 0;
  scan.axes.forEach((axis, a) => {
    for (const [name, options] of FIGURES) {
      const points = scan.points.map((point) => ({ x: axis.numbers ? axis.numbers[point.place[a]] : point.place[a], y: point[name],
        low: point[`${name}_interval`][0], high: point[`${name}_interval`][1], n: `${point.n_shots} shots`, text: axis.words[point.place[a]] })).sort((p, q) => p.x - q.x);
      const format = axis.numbers ? (x) => String(Number(x.toPrecision(4))) : (x) => axis.words[x] ?? "";
      curve(parts.curves[box++], points, { ...options, x: `${shortName(axis.address)}${axis.unit ? ` in ${axis.unit}` : ""}`, formatX: format, whole: false, line: scan.axes.length === 1, height: () => 240 });
    }
  });
}

function drawMaps(parts, scan) {
  replace(parts.maps, FIGURES.map(([name, options]) => el("div", {}, el("h3", {}, options.label),
    heatMap(scan.axes, scan.points.map((p) => ({ i: p.place[0], j: p.place[1], value: p[name], text: `${p.written.join(", ")}: ${percentWithError(p[name], p[`${name}_interval`])}` })), options.label, (v) => percent(v, 1)))));
}

function drawVisits(parts, scan) {
  const points = scan.visits.map((visit, i) => ({ x: i, y: visit.value, text: `${i} (${Object.values(visit.written).join(", ")})` }));
  if (points.length) curve(parts.visits, points, { x: "visit", label: scan.figure, format: (v) => Number(v.toPrecision(4)).toString(), ink: "blue", formatX: (x) => String(Math.round(x)), height: () => 240 });
  replace(parts.best, scan.best ? [el("div.tile-value", {}, scan.best.value === null ? "–" : Number(scan.best.value.toPrecision(5)).toString()),
    el("dl.facts", {}, Object.entries(scan.best.written).map(([address, value]) => [el("dt", {}, address), el("dd", {}, value)]))] : el("p.hint", {}, "no point has a value yet"));
}

function pointTable(scan) {
  const addresses = scan.points[0].written.length === scan.axes.length ? scan.axes.map((axis) => shortName(axis.address)) : scan.points[0].written.map((_, i) => `value ${i}`);
  const heads = [...addresses, { text: "shots", right: true }, { text: "filling", right: true }, { text: "defect-free", right: true }];
  return table(heads, scan.points.map((point) => [...point.written, String(point.n_shots), percentWithError(point.filling, point.filling_interval), percent(point.defect_free)]), { label: "Points of the scan" });
}

