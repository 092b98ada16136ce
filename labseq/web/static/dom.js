// Small helpers: elements, numbers and texts, requests. All texts reach the page as text nodes.

export function el(tag, props = {}, ...children) {
  const [name, ...classes] = tag.split(".");
  const node = document.createElement(name || "div");
  if (classes.length) node.className = classes.join(" ");
  for (const [key, value] of Object.entries(props)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) { node[key] = value; (node.handlers ??= {})[key] = value; }
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

const sorts = new Map();  // label of a table -> column and direction that its reader has chosen

// rows: lists of cells, or {mark, cells}; or a function that returns them
export function table(heads, rows, props = {}) {
  const label = props.label ?? "values";
  const parts = () => {
    const sort = sorts.get(label), listed = typeof rows === "function" ? rows() : rows;
    return [el("thead", {}, el("tr", {}, heads.map((head, i) => headCell(head, sort?.column === i ? sort : null, (event) => {
      sorts.set(label, sort?.column !== i ? { column: i, sign: 1 } : sort.sign > 0 ? { column: i, sign: -1 } : null);
      patch(event.currentTarget.closest("table"), parts());
    })))),
    el("tbody", {}, sorted(listed, sort).map((row) => el("tr", { class: row.mark ?? "" }, (row.cells ?? row).map((cell, i) => el("td", { class: heads[i]?.right ? "num" : heads[i]?.line ? "line" : "" }, cell ?? "–")))))];
  };
  return el("div.scroller", { tabindex: "0", role: "region", "aria-label": `${label}, a table` }, el("table", {}, parts()));
}

function headCell(head, sort, onclick) {
  const text = head.text ?? head, kind = head.right ? "num" : "";
  if (text === "") return el("td", {});
  return el("th", { class: kind, scope: "col", "aria-sort": sort ? (sort.sign > 0 ? "ascending" : "descending") : null }, el("button.sort", { type: "button", onclick }, text));
}

function sorted(rows, sort) {
  if (!sort) return rows;
  const keyed = rows.map((row) => [sortKey((row.cells ?? row)[sort.column]), row]);
  return keyed.sort(([a], [b]) => {
    if (a === null || b === null) return (a === null) - (b === null);  // what is unknown comes last
    return sort.sign * (typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true }));
  }).map(([, row]) => row);
}

const PREFIXES = { p: 1e-12, n: 1e-9, "µ": 1e-6, u: 1e-6, m: 1e-3, k: 1e3, M: 1e6, G: 1e9 };

// A number with its unit as a number: "97.6(3) ms"; any other text as it is
function sortKey(cell) {
  const text = (cell instanceof Node ? cell.textContent : String(cell ?? "")).trim();
  if (text === "" || text === "–") return null;
  const [, number, unit = ""] = text.match(/^(-?[\d.]+(?:e[-+]?\d+)?)(?:\(\d+\))?(?: (\S{1,4}))?$/i) ?? [];
  if (number === undefined) return text;
  return Number(number) * (unit === "min" ? 60 : unit.length > 1 ? PREFIXES[unit[0]] ?? 1 : 1);
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

const nodesOf = (children) => children.flat(9).filter((child) => child !== null && child !== undefined && child !== false)
  .map((child) => (child instanceof Node ? child : document.createTextNode(child)));

export function replace(node, ...children) { node.replaceChildren(...nodesOf(children)); }

// Makes the children of a node equal to new ones, but keeps the elements that are there: a click, a focus or
// an open list is not lost when the state changes between the press and the release of a button.
export function patch(node, ...children) {
  const next = nodesOf(children);
  next.forEach((child, i) => {
    const old = node.childNodes[i];
    if (!old) node.append(child);
    else if (old.nodeName !== child.nodeName) old.replaceWith(child);
    else if (old !== child) patchNode(old, child);
  });
  while (node.childNodes.length > next.length) node.lastChild.remove();
}

function patchNode(old, next) {
  if (old.nodeType === Node.TEXT_NODE) {
    if (old.data !== next.data) old.data = next.data;
    return;
  }
  for (const { name, value } of next.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  for (const { name } of [...old.attributes]) if (!next.hasAttribute(name) && !(old.nodeName === "DETAILS" && name === "open")) old.removeAttribute(name);
  for (const name of Object.keys({ ...old.handlers, ...next.handlers })) old[name] = next.handlers?.[name] ?? null;
  old.handlers = next.handlers;
  patch(old, [...next.childNodes]);
  if (["INPUT", "SELECT"].includes(old.nodeName) && old !== document.activeElement) {
    old.value = next.value;
    if (old.checked !== next.checked) old.checked = next.checked;
  }
}
