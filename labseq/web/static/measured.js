// What a run measures: values as text, tiles, trends, and curves against a scanned value with their fits.
import { curve } from "./charts.js";
import { count, el, patch, percent, percentWithError, table, withError } from "./dom.js";

const OF_TARGET = { filling: "Filling", defect_free: "Defect-free" };  // every run with a target has these
export const isOfTarget = (quantity) => quantity.name in OF_TARGET;
export const titleOf = (quantity) => OF_TARGET[quantity.name] ?? quantity.title;
// The end of an address: "duration", "offset.0"
export const shortName = (address) => address.split(" with ").map((one) => one.match(/[^.]*(\.\d+)*$/)[0]).join(" with ");

export const axisName = (axis) => `${shortName(axis.address)}${axis.unit ? ` in ${axis.unit}` : ""}`;

export function valueText(quantity, value) {
  if (value === null || value === undefined) return "–";
  if (quantity.is_fraction) return `${Number((100 * value).toFixed(2))} %`;
  return `${Number((value / quantity.factor).toPrecision(4))} ${quantity.unit}`.trim();
}

// A mean with its error; of a rate without, because its interval is not symmetric
export function meanText(quantity, { value, interval, n_trials }) {
  if (value === null) return "–";
  if (quantity.is_fraction) return n_trials === undefined ? percentWithError(value, interval) : percent(value);
  const error = interval[0] === null ? 0 : (interval[1] - interval[0]) / 2 / quantity.factor;
  return `${withError(value / quantity.factor, error)} ${quantity.unit}`.trim();
}

export function countText({ value, interval, n, n_trials }) {
  return value === null || n_trials === undefined ? "" : `${n} of ${n_trials}, ${(100 * interval[0]).toFixed(1)} to ${(100 * interval[1]).toFixed(1)} %`;
}

// The same with the interval of a rate
export function fullText(quantity, mean) {
  const { value, interval, n_trials } = mean;
  return value === null || n_trials === undefined ? meanText(quantity, mean) : `${percent(value)} (${(100 * interval[0]).toFixed(1)} to ${(100 * interval[1]).toFixed(1)})`;
}

export function tile(name, value, note, kind = "") {
  return el("div.tile", { class: kind }, el("div.tile-name", {}, name), el("div.tile-value", {}, value), el("div.tile-note", {}, note || "\u00a0"));
}

// Tiles of what a run measures beside filling and defect-free shots: the result of the fit comes first.
export function measuredTiles(measured, scan) {
  const fits = (scan?.quantities ?? []).filter((one) => one.fits.length).map((one) => fitTile(one));
  const means = measured.filter((one) => !isOfTarget(one)).map((one) => tile(titleOf(one), meanText(one, one), countText(one) || "mean of all shots", "is-blue"));
  return [...fits, ...means];
}

// The reported value; of several fits their range
function fitTile(quantity) {
  const made = quantity.fits.filter((fit) => !fit.error).sort((a, b) => reported(a).value - reported(b).value);
  if (!made.length) return tile(`fit of ${titleOf(quantity)}`, "–", quantity.fits[0].error, "is-fit");
  const [{ model, report }] = made, ends = [made[0], made[made.length - 1]].map((fit) => Number((reported(fit).value / report.factor).toPrecision(4)));
  if (made.length === 1) return tile(report.name, report.text, `${model}, ${made[0].at.length ? `at ${made[0].at.join(", ")}` : chiSquare(made[0])}`, "is-fit");
  return tile(report.name, `${ends.join(" to ")} ${report.unit}`, `${model}, ${made.length} of ${count(quantity.fits.length, "fit")}`, "is-fit");
}

const reported = (fit) => fit.parameters[fit.report.name];
const chiSquare = (fit) => (fit.reduced_chi_square === null ? "points without errors" : `reduced χ² ${fit.reduced_chi_square.toFixed(2)}`);

// The fit of a quantity; several as a table with a row at each value of the other axes
export function fitLines(quantity, scan) {
  const [fit] = quantity.fits;
  if (!fit) return null;
  if (fit.at.length) return fitTable(quantity, scan);
  if (fit.error) return el("p.fit-line.note", {}, "no fit: ", fit.error);
  const others = Object.entries(fit.parameters).filter(([name]) => name !== fit.report.name).map(([name, one]) => `${name} ${one.text}`);
  return el("p.fit-line", {}, el("strong", {}, `${fit.report.name} ${fit.report.text}`), el("span.note", {}, [`${fit.model}`, ...others, chiSquare(fit), count(fit.n_points, "point")].join(" · ")));
}

function fitTable(quantity, scan) {
  const fitted = quantity.fits.flatMap((fit) => Object.entries(fit.parameters ?? {}).filter(([, one]) => one.error).map(([name]) => name)), names = [...new Set(fitted)];
  const hasFailed = quantity.fits.some((fit) => fit.error);
  const heads = [...scan.axes.slice(1).map((axis) => shortName(axis.address)), ...[...names, "reduced χ²"].map((text) => ({ text, right: true })), ...(hasFailed ? ["why there is no fit"] : [])];
  const rows = quantity.fits.map((fit) => [...fit.at, ...names.map((name) => fit.parameters?.[name]?.text), fit.reduced_chi_square?.toFixed(2), ...(hasFailed ? [fit.error] : [])]);
  return table(heads, rows, { label: `Fits of ${titleOf(quantity)}` });
}

// The chart of the reported parameter against the second axis: {node, draw}
export function parameterCurve() {
  const head = el("h3"), box = el("div.chart"), lines = el("div"), node = el("div", {}, head, box, lines);
  function draw(scan, q, height) {
    const quantity = scan.quantities[q], made = quantity.fits.filter((fit) => !fit.error && fit.at.length);
    patch(lines, fitLines(quantity, scan));
    head.hidden = box.hidden = !made.length;
    if (!made.length) return;
    const axis = scan.axes[1], numbers = scan.axes.length === 2 ? axis.numbers : null, { name, unit, factor } = made[0].report;
    const x = scan.axes.slice(1).map(axisName).join(", ");
    head.textContent = `${name} by ${x}`;
    const points = made.map((fit) => {
      const { value, error } = reported(fit), i = numbers ? axis.words.indexOf(fit.at[0]) : quantity.fits.indexOf(fit);
      return { x: numbers ? numbers[i] : i, y: value, low: value - error, high: value + error, text: fit.at.join(", ") };
    }).sort((p, r) => p.x - r.x);
    curve(box, points, { x, label: name, format: (value) => `${Number((value / factor).toPrecision(4))} ${unit}`.trim(), ink: "move", height,
      formatX: numbers ? (x) => String(Number(x.toPrecision(4))) : (x) => quantity.fits[x]?.at.join(", ") ?? "", whole: !numbers });
  }
  return { node, draw };
}

function optionsOf(quantity) {
  const bounds = quantity.name === "filling" ? { highest: 1.0005 } : quantity.is_fraction ? { lowest: -0.02, highest: 1.02 } : {};
  return { label: titleOf(quantity), format: (value) => valueText(quantity, value), ink: quantity.name === "defect_free" ? "green" : "blue", ...bounds };
}

export function drawTrend(box, quantity, more = {}) {
  const points = quantity.trend.map((bin) => ({ x: bin.shot, y: bin.value, low: bin.interval[0], high: bin.interval[1], n: bin.n > 1 ? `${bin.n} shots` : "" }));
  curve(box, points, { ...optionsOf(quantity), x: "shot", whole: true, formatX: (x) => String(Math.round(x)), ...more });
}

// The chart of a quantity along an axis of the scan, with its fit and residuals, at some values of the other axes: {node, draw}
export function scanCurve() {
  const box = el("div.chart"), line = el("div"), residuals = el("div.chart"), below = el("div", { hidden: true }, el("h3", {}, "Residuals"), residuals);
  const node = el("div", {}, line, box, below);
  function draw(scan, q, height, { a = 0, at = null, more = {} } = {}) {
    const axis = scan.axes[a], quantity = scan.quantities[q], fit = quantity.fits.find((one) => String(one.at) === String(at ?? []) && !one.error);
    const format = axis.numbers ? (x) => String(Number(x.toPrecision(4))) : (x) => axis.words[x] ?? "";
    const along = { x: axisName(axis), formatX: format };
    const isThere = (point) => !at || at.every((word, i) => scan.axes[i + 1].words[point.place[i + 1]] === word);
    const points = scan.points.filter(isThere).map((point) => ({ x: axis.numbers ? axis.numbers[point.place[a]] : point.place[a], y: point.values[q].value, low: point.values[q].interval[0], high: point.values[q].interval[1],
      n: `${point.n_shots} shots`, text: axis.words[point.place[a]] })).sort((p, r) => p.x - r.x);
    patch(line, at || a ? null : fitLines(quantity, scan));
    curve(box, points, { ...optionsOf(quantity), ...along, line: (scan.axes.length === 1 || at !== null) && !quantity.fits.length, height, fit: fit?.curve, ...more });
    below.hidden = !fit;
    if (!fit) return;
    const left = fit.residuals.map((one) => ({ x: one.x, y: one.value, low: one.interval[0], high: one.interval[1] })).sort((p, r) => p.x - r.x);
    const ends = [Math.min(...fit.curve[0]), Math.max(...fit.curve[0])];
    curve(residuals, left, { ...along, label: `Residuals of ${titleOf(quantity)}`, format: (value) => valueText(quantity, value), line: false, height: () => 130, fit: [ends, [0, 0]] });
  }
  return { node, draw };
}
