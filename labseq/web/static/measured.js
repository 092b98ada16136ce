// What a run measures: values as text, tiles, trends, and curves against a scanned value with their fits.
import { curve } from "./charts.js";
import { count, el, patch, percent, percentWithError, withError } from "./dom.js";

const OF_TARGET = { filling: "Filling", defect_free: "Defect-free" };  // every run with a target has these
export const isOfTarget = (quantity) => quantity.name in OF_TARGET;
export const titleOf = (quantity) => OF_TARGET[quantity.name] ?? quantity.title;
export const shortName = (address) => address.split(" with ").map((one) => one.split(".").pop()).join(" with ");

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
  const fits = (scan?.quantities ?? []).filter((one) => one.fit).map((one) => tile(one.fit.report ? one.fit.report.name : `fit of ${titleOf(one)}`,
    one.fit.report?.text ?? "–", one.fit.error || `${one.fit.model}, ${chiSquare(one.fit)}`, "is-fit"));
  const means = measured.filter((one) => !isOfTarget(one)).map((one) => tile(titleOf(one), meanText(one, one), countText(one) || "mean of all shots", "is-blue"));
  return [...fits, ...means];
}

const chiSquare = (fit) => (fit.reduced_chi_square === null ? "points without errors" : `reduced χ² ${fit.reduced_chi_square.toFixed(2)}`);

export function fitLine(fit) {
  if (!fit) return null;
  if (fit.error) return el("p.fit-line.note", {}, "no fit: ", fit.error);
  const others = Object.entries(fit.parameters).filter(([name]) => name !== fit.report.name).map(([name, one]) => `${name} ${one.text}`);
  return el("p.fit-line", {}, el("strong", {}, `${fit.report.name} ${fit.report.text}`), el("span.note", {}, [`${fit.model}`, ...others, chiSquare(fit), count(fit.n_points, "point")].join(" · ")));
}

function optionsOf(quantity) {
  const bounds = quantity.name === "filling" ? { highest: 1.0005 } : quantity.is_fraction ? { lowest: -0.02, highest: 1.02 } : {};
  return { label: titleOf(quantity), format: (value) => valueText(quantity, value), ink: quantity.name === "defect_free" ? "green" : "blue", ...bounds };
}

export function drawTrend(box, quantity, more = {}) {
  const points = quantity.trend.map((bin) => ({ x: bin.shot, y: bin.value, low: bin.interval[0], high: bin.interval[1], n: bin.n > 1 ? `${bin.n} shots` : "" }));
  curve(box, points, { ...optionsOf(quantity), x: "shot", whole: true, formatX: (x) => String(Math.round(x)), ...more });
}

// The chart of a quantity along an axis of the scan, with its fit and residuals: {node, draw}
export function scanCurve() {
  const box = el("div.chart"), line = el("div"), residuals = el("div.chart"), below = el("div", { hidden: true }, el("h3", {}, "Residuals"), residuals);
  const node = el("div", {}, line, box, below);
  function draw(scan, q, a, height) {
    const axis = scan.axes[a], quantity = scan.quantities[q], { fit } = quantity;
    const format = axis.numbers ? (x) => String(Number(x.toPrecision(4))) : (x) => axis.words[x] ?? "";
    const along = { x: axisName(axis), formatX: format };
    const points = scan.points.map((point) => ({ x: axis.numbers ? axis.numbers[point.place[a]] : point.place[a], y: point.values[q].value, low: point.values[q].interval[0], high: point.values[q].interval[1],
      n: `${point.n_shots} shots`, text: axis.words[point.place[a]] })).sort((p, r) => p.x - r.x);
    patch(line, fitLine(fit));
    curve(box, points, { ...optionsOf(quantity), ...along, line: scan.axes.length === 1 && !fit, height, fit: fit?.curve });
    below.hidden = !fit?.residuals;
    if (!fit?.residuals) return;
    const left = fit.residuals.map((one) => ({ x: one.x, y: one.value, low: one.interval[0], high: one.interval[1] })).sort((p, r) => p.x - r.x);
    const ends = [Math.min(...fit.curve[0]), Math.max(...fit.curve[0])];
    curve(residuals, left, { ...along, label: `Residuals of ${titleOf(quantity)}`, format: (value) => valueText(quantity, value), line: false, height: () => 130, fit: [ends, [0, 0]] });
  }
  return { node, draw };
}
