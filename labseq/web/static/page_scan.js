// The scan of the newest run, or of one run, as it fills.
import { go, setLink } from "./app.js";
import { closeCharts, curve, heatMap } from "./charts.js";
import { el, getJson, panel, patch, replace, runPath, table } from "./dom.js";
import { follow } from "./live.js";
import { axisName, fullText, parameterCurve, scanCurve, shortName, titleOf, valueText } from "./measured.js";
import { alarmList, headOf } from "./page_now.js";

export async function showScan(main, _, asked) {
  const id = asked.get("run"), quantity = asked.get("quantity") ?? "";
  const query = new URLSearchParams({ day: id?.split("/")[0] ?? "", name: id?.split("/")[1] ?? "", quantity });
  const head = el("div.run-head"), choice = el("div.tools"), body = el("div.grid");
  let shape = "";
  const choose = (event) => go(`/scan?${new URLSearchParams({ ...(id ? { run: id } : {}), ...(event.target.value ? { quantity: event.target.value } : {}) })}`, { replaceIt: true });
  const draw = (state) => {
    if (!state.run) { replace(main, alarmList(state.alarms), el("p.hint", {}, "There is no run yet.")); shape = ""; return; }
    const { scan } = state;
    const next = JSON.stringify([state.run.id, scan?.axes?.map((axis) => axis.words), scan?.is_map, scan?.quantities?.map((one) => one.name)]);
    if (next !== shape) { closeCharts(); body.replaceChildren(); body.parts = null; replace(main, head, choice, body); }
    shape = next;
    patch(head, headOf(state.run, state));
    patch(choice, scan ? chooser(scan, quantity, choose) : null);
    document.title = `Scan ${state.run.name} · labseq`;
    drawScan(body, scan);
  };
  return follow(`?${query}`, draw, setLink);
}

function chooser(scan, quantity, onchange) {
  const names = [...new Set([...(quantity ? [quantity] : []), ...(scan.choices ?? [])])];
  return [el("label", {}, "Quantity ", el("select", { "aria-label": "Quantity", onchange },
    el("option", { value: "", selected: !quantity }, "what the run measures"), names.map((name) => el("option", { value: name, selected: name === quantity }, name)))),
  scan.n_unread ? el("span.note", { role: "status" }, `${scan.n_unread} shots have not been read yet`) : null];
}

export async function scanOfRun(body, id) {
  const scan = await getJson(`/runs/${runPath(id)}/scan`);
  drawScan(body, scan);
  return scan;
}

function drawScan(body, scan) {
  if (!scan) { replace(body, panel("Scan", { class: "wide" }, el("p.hint", {}, "This run has no scan. "), el("p.hint", {}, el("a", { href: "/runs?q=" }, "Runs with a scan")))); return; }
  if (scan.error) { replace(body, el("div.alarm.is-error", {}, el("strong", {}, "The scan cannot be shown"), el("span", {}, scan.error))); return; }
  if (!scan.points.length) { replace(body, panel("Scan", { class: "wide" }, el("p.hint", {}, "No point has a shot yet."))); return; }
  const parts = body.parts ??= makeParts(body, scan);
  if (scan.visits) drawVisits(parts, scan);
  if (scan.is_map) drawMaps(parts, scan);
  else for (const { chart, q, a } of parts.curves) chart.draw(scan, q, () => 240, { a });
  for (const fits of parts.fits) drawFits(fits, scan);
  patch(parts.table, pointTable(scan));
}

function makeParts(body, scan) {
  const parts = { visits: el("div.chart"), best: el("div"), table: el("div"), maps: el("div.maps"), curves: [], fits: [] };
  const panels = [];
  if (scan.visits) panels.push(panel(`${scan.figure}: points in the order they were tried`, { class: "half" }, parts.visits), panel("Best so far", { class: "half" }, parts.best));
  if (scan.is_map) {
    panels.push(panel("Map", { class: "wide" }, parts.maps));
    parts.fits = scan.quantities.map((quantity, q) => ({ quantity, q })).filter(({ quantity }) => quantity.fits.length)
      .map(({ q }) => ({ q, at: null, values: parameterCurve(), slice: scanCurve(), choice: el("div.choice") }));
    for (const { q, values, slice, choice } of parts.fits) {
      const title = titleOf(scan.quantities[q]);
      panels.push(panel(`Fits of ${title} along ${axisName(scan.axes[0])}`, { class: "half" }, values.node), panel(title, { class: "half", aside: choice }, slice.node));
    }
  } else {
    const kind = scan.axes.length * scan.quantities.length === 1 ? "wide" : "half";
    scan.axes.forEach((axis, a) => scan.quantities.forEach((quantity, q) => {
      const chart = scanCurve();
      parts.curves.push({ chart, q, a });
      panels.push(panel(`${titleOf(quantity)} by ${axisName(axis)}`, { class: kind }, chart.node));
    }));
  }
  panels.push(panel("Points", { class: "wide" }, parts.table));
  replace(body, panels);
  return parts;
}

function drawMaps(parts, scan) {
  patch(parts.maps, scan.quantities.map((quantity, q) => el("div", {}, el("h3", {}, titleOf(quantity)),
    heatMap(scan.axes, scan.points.map((p) => ({ i: p.place[0], j: p.place[1], value: p.values[q].value, text: `${p.written.join(", ")}: ${fullText(quantity, p.values[q])}` })), titleOf(quantity), (value) => valueText(quantity, value)))));
}

// Of a map with fits: the reported parameter against the second axis, and one of the fits with its points.
function drawFits(fits, scan) {
  fits.values.draw(scan, fits.q, () => 200);
  const others = scan.axes.slice(1), words = (point) => others.map((axis, i) => axis.words[point.place[i + 1]]);
  const places = [...new Map(scan.points.map((point) => [String(words(point)), words(point)])).entries()];
  const [, at] = places.find(([key]) => key === fits.at) ?? places[0];
  const onchange = (event) => { fits.at = event.target.value; drawFits(fits, scan); };
  patch(fits.choice, el("label", {}, `at ${others.map((axis) => shortName(axis.address)).join(", ")} `, el("select", { "aria-label": "Fit to show", onchange },
    places.map(([key, one]) => el("option", { value: key, selected: key === String(at) }, one.join(", "))))));
  fits.slice.draw(scan, fits.q, () => 200, { at });
}

function drawVisits(parts, scan) {
  const points = scan.visits.map((visit, i) => ({ x: i, y: visit.value, text: `${i} (${Object.values(visit.written).join(", ")})` }));
  if (points.length) curve(parts.visits, points, { x: "visit", label: scan.figure, format: (v) => Number(v.toPrecision(4)).toString(), ink: "blue", whole: true, formatX: (x) => String(Math.round(x)), height: () => 240 });
  patch(parts.best, scan.best ? [el("div.tile-value", {}, scan.best.value === null ? "–" : Number(scan.best.value.toPrecision(5)).toString()),
    el("dl.facts", {}, Object.entries(scan.best.written).map(([address, value]) => [el("dt", {}, address), el("dd", {}, value)]))] : el("p.hint", {}, "no point has a value yet"));
}

function pointTable(scan) {
  const addresses = scan.points[0].written.length === scan.axes.length ? scan.axes.map((axis) => shortName(axis.address)) : scan.points[0].written.map((_, i) => `value ${i}`);
  const heads = [...addresses, { text: "shots", right: true }, ...scan.quantities.map((one) => ({ text: one.title, right: true }))];
  return table(heads, scan.points.map((point) => [...point.written, String(point.n_shots), ...scan.quantities.map((one, q) => fullText(one, point.values[q]))]), { label: "Points of the scan" });
}
