// Charts: curves with error bars by uPlot; maps and bars as SVG.
import { colour, el, svg } from "./dom.js";

const open = new Set();
const observer = new ResizeObserver((entries) => {
  for (const { target, contentRect } of entries) {
    const chart = target.chart;
    if (chart && contentRect.width > 40) chart.setSize({ width: Math.floor(contentRect.width), height: target.chartHeight() });
  }
});

export function closeCharts() {
  for (const box of open) { observer.unobserve(box); box.chart.destroy(); }
  open.clear();
}

export function redrawCharts() {  // after a change of the theme
  for (const box of open) box.remake();
}

// points: [{x, y, low, high}], options: {x, y, label, format, ink, height, line, lowest, fit}; fit: [[x], [y]] of a curve
export function curve(box, points, options) {
  box.options = options;
  const data = [points.map((p) => p.x), points.map((p) => p.y), points.map((p) => p.low ?? p.y), points.map((p) => p.high ?? p.y)];
  if (box.chart) {
    box.points = points;
    box.chart.setData(data);
    describe(box, points, options);
    return;
  }
  box.points = points;
  box.chartHeight = () => box.options.height?.() ?? 190;
  box.remake = () => {
    const now = [0, 1, 2, 3].map((i) => box.points.map((p) => [p.x, p.y, p.low ?? p.y, p.high ?? p.y][i]));
    if (box.chart) box.chart.destroy();
    box.chart = new uPlot(chartOptions(box, box.options), now, box.plot);
  };
  box.readout = el("div.readout", { "aria-hidden": "true" });
  box.plot = el("div.plot");
  box.replaceChildren(box.plot, box.readout);
  box.setAttribute("role", "img");
  describe(box, points, options);
  box.remake();
  open.add(box);
  observer.observe(box);
}

function describe(box, points, options) {
  const known = points.filter((p) => p.y !== null && p.y !== undefined);
  const last = known[known.length - 1];
  box.setAttribute("aria-label", last
    ? `${options.label}: ${known.length} points, the last ${options.format(last.y)} at ${options.x} ${options.formatX?.(last.x) ?? last.x}`
    : `${options.label}: no points yet`);
}

function chartOptions(box, options) {
  const ink = colour(options.ink ?? "blue"), soft = colour("ink-2"), grid = colour("grid");
  const font = `${Math.round(0.75 * parseFloat(getComputedStyle(document.documentElement).fontSize))}px ${getComputedStyle(document.body).fontFamily}`;
  const rem = parseFloat(getComputedStyle(document.documentElement).fontSize);
  const axis = { stroke: soft, font, grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1, size: 4 } };
  return {
    width: Math.max(60, Math.floor(box.clientWidth)), height: box.chartHeight(),
    padding: [10, 10, 0, 0], legend: { show: false },
    cursor: { y: false, points: { size: 8 }, drag: { setScale: true, x: true, y: false } },
    scales: { x: { time: Boolean(options.isTime), range: (_, low, high) => (low === high ? [low - 1, high + 1] : [low - 0.02 * (high - low), high + 0.02 * (high - low)]) },
      y: { range: () => rangeOf(box.points, box.options) } },
    axes: [{ ...axis, size: 2 * rem, space: 4.5 * rem, ...(options.whole ? { incrs: WHOLE } : {}), values: options.formatX ? (_, all) => all.map((x) => box.options.formatX(x)) : undefined },
      { ...axis, size: 4.2 * rem, space: (box.chartHeight() < 150 ? 1.3 : 2.4) * rem, values: (_, all) => all.map((y) => box.options.format(y)) }],
    series: [{}, { stroke: ink, width: options.line === false ? 0 : 1.6, spanGaps: true,
      points: { show: true, size: box.points.length > 60 ? 3 : 6, fill: ink, stroke: ink } }, { show: false }, { show: false }],
    hooks: { draw: [(u) => drawBars(u, ink), (u) => drawFit(u, box.options)], setCursor: [(u) => showValue(u, box, box.options)] },
  };
}

function rangeOf(points, options) {
  if (options.fixed) return options.fixed;
  const ends = [...points.flatMap((p) => [p.y, p.low, p.high]), ...(options.fit?.[1] ?? [])].filter((v) => v !== null && v !== undefined && Number.isFinite(v));
  if (!ends.length) return options.range ?? [0, 1];
  let low = Math.min(...ends), high = Math.max(...ends);
  const pad = 0.08 * (high - low || Math.abs(high) || 1);
  low = Math.max(options.lowest ?? -Infinity, low - pad);
  high = Math.min(options.highest ?? Infinity, high + pad);
  return low < high ? [low, high] : [low - 0.5, high + 0.5];
}

function drawBars(u, ink) {
  const { ctx } = u, [xs, , lows, highs] = u.data;
  ctx.save();
  ctx.strokeStyle = ink;
  ctx.globalAlpha = xs.length > 60 ? 0.35 : 0.6;
  ctx.lineWidth = 1.3 * devicePixelRatio;
  ctx.beginPath();
  xs.forEach((x, i) => {
    if (lows[i] === null || highs[i] === null || lows[i] === highs[i]) return;
    const px = Math.round(u.valToPos(x, "x", true));
    ctx.moveTo(px, u.valToPos(lows[i], "y", true));
    ctx.lineTo(px, u.valToPos(highs[i], "y", true));
  });
  ctx.stroke();
  ctx.restore();
}

function drawFit(u, { fit }) {
  if (!fit) return;
  const { ctx } = u, { left, top, width, height } = u.bbox;
  ctx.save();
  ctx.beginPath();
  ctx.rect(left, top, width, height);
  ctx.clip();
  ctx.strokeStyle = colour("move");
  ctx.lineWidth = 1.8 * devicePixelRatio;
  ctx.beginPath();
  fit[0].forEach((x, i) => fit[1][i] !== null && ctx.lineTo(u.valToPos(x, "x", true), u.valToPos(fit[1][i], "y", true)));
  ctx.stroke();
  ctx.restore();
}

function showValue(u, box, options) {
  const i = u.cursor.idx;
  const point = i === null || i === undefined ? null : box.points[i];
  box.readout.textContent = point && point.y !== null
    ? `${options.x} ${point.text ?? options.formatX?.(point.x) ?? point.x}: ${options.format(point.y)}${point.n ? ` (${point.n})` : ""}` : "";
}

export const WHOLE = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000, 20_000, 50_000, 100_000, 1_000_000];

// A bar for each row: {name, value, error, text}
export function bars(rows, label) {
  const most = Math.max(1e-12, ...rows.map((row) => row.value));
  return el("ul.bars", { "aria-label": label }, rows.map((row) => {
    const share = 100 * row.value / most;
    return el("li", {}, el("span.bar-name", {}, row.name),
      svgBar(share, row.class), el("span.bar-value", {}, row.text));
  }));
}

function svgBar(share, kind = "") {
  const bar = svg("svg", { viewBox: "0 0 100 6", preserveAspectRatio: "none", class: `bar ${kind}`, "aria-hidden": "true" });
  bar.append(svg("rect", { class: "bar-back", x: 0, y: 0, width: 100, height: 6 }), svg("rect", { class: "bar-fill", x: 0, y: 0, width: share.toFixed(2), height: 6 }));
  return bar;
}

// A stage's median and 99th percentile against its budget
export function stageBar(stage) {
  const most = Math.max(stage.budget_s ?? 0, stage.p99_s ?? 0, 1e-12);
  const bar = svg("svg", { viewBox: "0 0 100 8", preserveAspectRatio: "none", class: `bar ${stage.n_over ? "is-over" : ""}`, "aria-hidden": "true" });
  const x = (s) => (100 * Math.min(1, (s ?? 0) / (1.08 * most))).toFixed(2);
  bar.append(svg("rect", { class: "bar-back", x: 0, y: 0, width: 100, height: 8 }),
    svg("rect", { class: "bar-soft", x: 0, y: 1, width: x(stage.p99_s), height: 6 }),
    svg("rect", { class: "bar-fill", x: 0, y: 1, width: x(stage.median_s), height: 6 }));
  if (stage.budget_s) bar.append(svg("rect", { class: "bar-mark", x: x(stage.budget_s), y: 0, width: 0.8, height: 8 }));
  return bar;
}

export function progressBar(done, total) {
  const share = total ? Math.min(100, 100 * done / total) : 0;
  const bar = svgBar(share, "is-progress");
  return el("div.progress", { role: "progressbar", "aria-label": "Shots", "aria-valuemin": "0", "aria-valuemax": String(total), "aria-valuenow": String(done) }, bar);
}

// A map of two scanned values: cells [{i, j, value, text}]
export function heatMap(axes, cells, label, format) {
  const values = cells.map((cell) => cell.value).filter((v) => v !== null);
  const low = Math.min(...values), high = Math.max(...values);
  const body = axes[0].words.map((word, i) => el("tr", {}, el("th", { scope: "row" }, word),
    axes[1].words.map((_, j) => {
      const cell = cells.find((one) => one.i === i && one.j === j);
      if (!cell || cell.value === null) return el("td.cell.is-empty", {}, "·");
      const step = high > low ? Math.round(8 * (cell.value - low) / (high - low)) : 4;
      return el("td.cell", { class: `heat-${step}`, title: cell.text }, format(cell.value));
    })));
  return el("div.scroller", { tabindex: "0", role: "region", "aria-label": label },
    el("table.heat", {}, el("caption", {}, `${axes[0].address} down, ${axes[1].address} across`),
      el("thead", {}, el("tr", {}, el("td", {}, ""), axes[1].words.map((word) => el("th", { scope: "col" }, word)))), el("tbody", {}, body)));
}

// A quantity at each site: at: positions of the sites in row order, [x, y]; values: null where there are too few atoms
export function siteMap(at, values, text, label) {
  const known = values.filter((value) => value !== null), low = Math.min(...known), high = Math.max(...known);
  const xs = at.map((p) => p[0]), ys = at.map((p) => p[1]), left = Math.min(...xs) - 1, top = Math.min(...ys) - 1;
  const box = [left, top, Math.max(...xs) - left + 1, Math.max(...ys) - top + 1];
  const step = (value) => value === null ? "none" : high > low ? Math.round(8 * (value - low) / (high - low)) : 4;
  return svg("svg", { viewBox: box.join(" "), class: "sites", role: "img", "aria-label": label }, ...at.map(([cx, cy], i) =>
    svg("circle", { cx, cy, r: 0.46, class: `site-${step(values[i])}` }, svg("title", {}, text(i)))));
}
