// Small helpers: elements, numbers and texts, requests. All texts reach the page as text nodes.

export function el(tag, props = {}, ...children) {
  const [name, ...classes] = tag.split(".");
  const node = document.createElement(name || "div");
  if (classes.length) node.className = classes.join(" ");
  for (const [key, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) node.addEventListener(key.slice(2), value);
    else if (key === "class") node.className += ` ${value}`;
    else if (key in node && key !== "list" && !key.startsWith("aria")) node[key] = value;
    else node.setAttribute(key, value === true ? "" : value);
  }
  node.append(...children.flat(9).filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

const SVG = "http://www.w3.org/2000/svg";
export function svg(tag, props = {}, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [key, value] of Object.entries(props)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

export function panel(title, props, ...children) {
  const heading = el("h2", {}, title);
  return el("section.panel", { ...props, "aria-label": title }, el("div.panel-head", {}, heading, props.aside), ...children);
}

export async function getJson(path) {
  const answer = await fetch(`/api/v1${path}`, { headers: { accept: "application/json" } });
  return unpack(answer);
}

export async function post(path, values) {
  const answer = await fetch(`/api/v1${path}`, {
    method: "POST", headers: { "content-type": "application/json" }, body: JSON.stringify(values),
  });
  return unpack(answer);
}

async function unpack(answer) {
  const text = await answer.text();
  let values;
  try { values = JSON.parse(text); } catch { values = { error: text.trim() || `status ${answer.status}` }; }
  if (!answer.ok) throw new Error(values.error || `status ${answer.status}`);
  return values;
}

export const runPath = (id) => id.split("/").map(encodeURIComponent).join("/");
export const runLink = (id, text) => el("a", { href: `/runs/${runPath(id)}` }, text ?? id);

export function percent(value, digits = 1) {
  return value === null || value === undefined ? "–" : `${(100 * value).toFixed(digits)} %`;
}

// A value with the error of its last digit in brackets: 97.66(4)
export function withError(value, error) {
  if (value === null || value === undefined) return "–";
  if (!(error > 1e-12 * Math.abs(value))) return Number(value.toPrecision(4)).toString();
  let digit = Math.floor(Math.log10(error));
  if (Math.round(error / 10 ** digit) === 10) digit += 1;
  const shown = Math.round(error / 10 ** digit);
  return digit >= 0 ? `${(Math.round(value / 10 ** digit) * 10 ** digit).toFixed(0)}(${shown * 10 ** digit})`
    : `${value.toFixed(-digit)}(${shown})`;
}

export function percentWithError(value, interval) {
  if (value === null || value === undefined) return "–";
  const error = interval && interval[0] !== null ? 50 * (interval[1] - interval[0]) : 0;
  return `${withError(100 * value, error)} %`;
}

const UNITS = [[1, "s"], [1e-3, "ms"], [1e-6, "µs"], [1e-9, "ns"]];
export function time(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  if (seconds === 0) return "0 s";
  if (seconds >= 120) return clock(seconds);
  const [factor, unit] = UNITS.find(([one]) => Math.abs(seconds) >= one) ?? UNITS[3];
  return `${Number((seconds / factor).toPrecision(3))} ${unit}`;
}

export function clock(seconds) {
  const total = Math.round(seconds), h = Math.floor(total / 3600), m = Math.floor(total / 60) % 60, s = total % 60;
  const two = (n) => String(n).padStart(2, "0");
  return h ? `${h}:${two(m)}:${two(s)}` : `${m}:${two(s)}`;
}

export function localTime(utc, withDate = true) {
  const at = new Date(utc);
  if (Number.isNaN(at.getTime())) return "–";
  const two = (n) => String(n).padStart(2, "0");
  const day = `${at.getFullYear()}-${two(at.getMonth() + 1)}-${two(at.getDate())}`;
  const of_day = `${two(at.getHours())}:${two(at.getMinutes())}`;
  return withDate ? `${day} ${of_day}` : `${of_day}:${two(at.getSeconds())}`;
}

export function count(n, noun) { return `${n} ${noun}${n === 1 ? "" : "s"}`; }

export function statusPill(status) {
  const marks = { running: "●", complete: "✓", stopped: "■", failed: "✕", damaged: "✕", interrupted: "✕", waiting: "…" };
  return el("span.pill", { class: `is-${status}` }, el("span", { "aria-hidden": "true" }, marks[status] ?? "·"), ` ${status}`);
}

export function table(heads, rows, props = {}) {
  const cells = (row, tag) => row.map((cell, i) => el(cell === "" ? "td" : tag, {
    class: heads[i]?.right ? "num" : "", scope: tag === "th" ? "col" : null }, cell ?? "–"));
  return el("div.scroller", { tabindex: "0", role: "region", "aria-label": `${props.label ?? "values"}, a table` },
    el("table", {}, el("thead", {}, el("tr", {}, cells(heads.map((h) => h.text ?? h), "th"))),
      el("tbody", {}, rows.map((row) => el("tr", { class: row.mark ?? "" }, cells(row.cells ?? row, "td"))))));
}

export function facts(values) {
  const pairs = Object.entries(values).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return el("dl.facts", {}, pairs.map(([name, value]) => [el("dt", {}, name), el("dd", {},
    value instanceof Node ? value : typeof value === "object" ? JSON.stringify(value) : String(value))]));
}

export function failure(error) {
  return el("div.alarm.is-error", { role: "alert" }, el("strong", {}, "This cannot be shown"), el("span", {}, error.message ?? String(error)));
}

export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

export function replace(node, ...children) { node.replaceChildren(...children.flat(9).filter(Boolean)); }
