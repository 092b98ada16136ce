// The frame of all pages: head, theme, navigation, and which page an address shows.
import { closeCharts, redrawCharts } from "./charts.js";
import { el, failure, getJson, replace } from "./dom.js";
import { showApi } from "./page_api.js";
import { showNow } from "./page_now.js";
import { showCompare, showRun, showRuns } from "./page_runs.js";
import { showScan } from "./page_scan.js";
import { showShot } from "./page_shot.js";
import { showCalibrations, showQueue } from "./page_store.js";

const PAGES = [
  [/^\/(now)?$/, showNow, "Now"],
  [/^\/scan$/, showScan, "Scan"],
  [/^\/runs$/, showRuns, "Runs"],
  [/^\/runs\/([^/]+)\/([^/]+)$/, showRun, "Runs"],
  [/^\/runs\/([^/]+)\/([^/]+)\/shots\/(\d+)$/, showShot, "Runs"],
  [/^\/compare$/, showCompare, "Runs"],
  [/^\/queue$/, showQueue, "Queue"],
  [/^\/calibrations$/, showCalibrations, "Calibrations"],
  [/^\/api$/, showApi, "API"],
];
const LINKS = [["Now", "/now"], ["Scan", "/scan"], ["Runs", "/runs"], ["Queue", "/queue"], ["Calibrations", "/calibrations"], ["API", "/api"]];

const main = document.getElementById("main");
const link = el("span.link", { role: "status" });
let leave = null;
export const server = { may_act: false };

function head(current) {
  replace(document.getElementById("top"),
    el("a.brand", { href: "/now", "aria-label": "labseq, now" }, el("img", { src: "/static/icon.svg", alt: "", width: 22, height: 22 }), "labseq"),
    el("nav", { "aria-label": "Pages" }, LINKS.map(([name, path]) => el("a", { href: path, "aria-current": name === current ? "page" : null }, name))),
    link,
    el("button.quiet", { type: "button", onclick: switchTheme, "aria-label": "Switch between dark and light" }, "◐"));
}

function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

function switchTheme() {
  const theme = isDark() ? "light" : "dark";
  document.documentElement.dataset.theme = theme;
  try { localStorage.setItem("labseq-theme", theme); } catch { /* no storage */ }
  redraw();
}

function redraw() {
  redrawCharts();
  document.dispatchEvent(new Event("themechange"));
}

export function setLink(isOn) {
  link.textContent = isOn ? "live" : "no connection";
  link.className = `link ${isOn ? "is-on" : "is-off"}`;
}

async function show() {
  if (leave) leave();
  leave = null;
  closeCharts();
  const path = location.pathname;
  const [pattern, page, name] = PAGES.find(([one]) => one.test(path)) ?? PAGES[0];
  const parts = path.match(pattern)?.slice(1).map((part) => decodeURIComponent(part ?? "")) ?? [];
  head(name);
  document.title = `${name} · labseq`;
  link.textContent = "";
  link.className = "link";
  const mine = {};
  show.latest = mine;
  replace(main, el("p.hint", {}, "Loading ..."));
  main.setAttribute("aria-busy", "true");
  try {
    const close = await page(main, parts, new URLSearchParams(location.search));
    if (show.latest === mine) leave = close ?? null;
    else if (close) close();
  } catch (error) {
    if (show.latest === mine) replace(main, failure(error));
  }
  if (show.latest === mine) main.setAttribute("aria-busy", "false");
}

// Links within the pages do not load everything again.
export function go(path, { replaceIt = false } = {}) {
  history[replaceIt ? "replaceState" : "pushState"](null, "", path);
  show();
}

document.addEventListener("click", (event) => {
  const anchor = event.target.closest?.("a[href^='/']");
  if (!anchor || event.defaultPrevented || event.button || event.metaKey || event.ctrlKey || event.shiftKey) return;
  if (anchor.target || anchor.pathname.startsWith("/api/v1") || anchor.pathname === "/metrics") return;
  event.preventDefault();
  go(anchor.getAttribute("href"));
  main.focus({ preventScroll: true });
  scrollTo(0, 0);
});
addEventListener("popstate", show);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);

try { Object.assign(server, await getJson("/server")); } catch { /* the page says so itself */ }
show();
