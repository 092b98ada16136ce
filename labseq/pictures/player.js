// Plays the motion of a plan, by drawing tones, tweezers and atoms at a time on a canvas.

// The values of knots [[time, value, ...], ...] at a time, straight between knots and constant outside.
export function valuesAt(knots, t) {
  let low = 0, high = knots.length - 1;
  if (t <= knots[0][0]) return knots[0].slice(1);
  if (t >= knots[high][0]) return knots[high].slice(1);
  while (high - low > 1) {
    const middle = (low + high) >> 1;
    if (knots[middle][0] <= t) low = middle; else high = middle;
  }
  const part = (t - knots[low][0]) / (knots[high][0] - knots[low][0]);
  return knots[low].slice(1).map((value, i) => value + part * (knots[high][i + 1] - value));
}

const KEY = "Lines are tones; at each crossing is a tweezer, filled if it holds an atom. A red ring is around an atom that will be lost; crosses are atoms lost (red) or ejected (grey).";

const place = (row, col) => `${row.toFixed(4)} ${col.toFixed(4)}`.replaceAll("-0.0000", "0.0000");
const isThere = (fate, t) => fate === null || t < fate[1];

// Everything at a time, in sites: tones [place, depth], tweezers [row, column, depth, holds an atom], atoms [row, column]
export function stateAt(scene, t) {
  const on = (tones) => tones.filter((knots) => knots[0][0] <= t && t < knots[knots.length - 1][0]).map((knots) => valuesAt(knots, t));
  const rows = on(scene.row_tones), columns = on(scene.column_tones), atoms = scene.atoms.map((knots) => valuesAt(knots, t));
  const held = new Set(atoms.filter((_, i) => isThere(scene.fates[i], t)).map(([row, col]) => place(row, col)));
  const tweezers = rows.flatMap(([row, deep]) => columns.map(([col, depth]) => [row, col, deep * depth, held.has(place(row, col))]));
  const ended = scene.batches.findIndex(([, end]) => t < end);
  return { batch: ended < 0 ? scene.batches.length : ended, rows, columns, tweezers, atoms };
}

// A cleared canvas as wide as its element, with a height in proportion
export function prepared(canvas, ratio) {
  const width = Math.max(80, canvas.clientWidth), dpr = Math.min(2, devicePixelRatio || 1);
  const height = Math.round(width * ratio);
  if (canvas.width !== Math.round(width * dpr) || canvas.height !== Math.round(height * dpr)) {
    canvas.width = Math.round(width * dpr);
    canvas.height = Math.round(height * dpr);
  }
  const ctx = canvas.getContext("2d");
  ctx.setTransform(dpr, 0, 0, dpr, 0, 0);
  ctx.clearRect(0, 0, width, height);
  return [ctx, width, height];
}

function extentOf({ n_rows, n_cols, axes: [a1, a2], atoms }) {
  const corners = [[0, 0], [0, n_cols - 1], [n_rows - 1, 0], [n_rows - 1, n_cols - 1]];
  let left = Infinity, right = -Infinity, top = Infinity, bottom = -Infinity;
  for (const [row, col] of [...corners, ...atoms.flatMap((knots) => knots.map((knot) => knot.slice(1)))]) {
    const x = col * a1[0] + row * a2[0], y = col * a1[1] + row * a2[1];
    [left, right, top, bottom] = [Math.min(left, x), Math.max(right, x), Math.min(top, y), Math.max(bottom, y)];
  }
  return { left: left - 1, top: top - 1, width: right - left + 2, height: bottom - top + 2 };
}

function drawScene(canvas, scene, extent, state, t, colour) {
  const [ctx, width] = prepared(canvas, extent.height / extent.width), [a1, a2] = scene.axes, unit = width / extent.width;
  const at = (row, col) => [(col * a1[0] + row * a2[0] - extent.left) * unit, (col * a1[1] + row * a2[1] - extent.top) * unit];
  const dot = ([row, col], r) => { const [x, y] = at(row, col); ctx.moveTo(x + r * unit, y); ctx.arc(x, y, r * unit, 0, 2 * Math.PI); };
  const line = (places) => places.forEach(([row, col], i) => ctx[i ? "lineTo" : "moveTo"](...at(row, col)));
  const cross = ([row, col]) => { const r = 0.34 * unit, [x, y] = at(row, col); ctx.moveTo(x - r, y - r); ctx.lineTo(x + r, y + r); ctx.moveTo(x - r, y + r); ctx.lineTo(x + r, y - r); };
  const paint = (how, name, draw, alpha = 1, thick = 0.1) => {
    ctx.globalAlpha = alpha;
    ctx.fillStyle = ctx.strokeStyle = colour(name);
    ctx.lineWidth = Math.max(1, thick * unit);
    ctx.beginPath();
    draw();
    ctx[how]();
    ctx.globalAlpha = 1;
  };
  const sites = scene.fill.flatMap((row, r) => [...row].map((wanted, c) => [r, c, wanted === "1"]));
  paint("fill", "goal", () => sites.forEach((site) => site[2] && dot(site, 0.52)));
  paint("fill", "site", () => sites.forEach((site) => dot(site, 0.09)));
  for (const [row, depth] of state.rows) paint("stroke", "move", () => line([[row, -0.8], [row, scene.n_cols - 0.2]]), 0.45 * Math.min(1, depth), 0.05);
  for (const [col, depth] of state.columns) paint("stroke", "move", () => line([[-0.8, col], [scene.n_rows - 0.2, col]]), 0.45 * Math.min(1, depth), 0.05);
  const since = scene.batches[state.batch]?.[0] ?? Infinity;
  paint("stroke", "move", () => scene.atoms.forEach((knots, i) => {
    const passed = knots.filter(([when]) => since <= when && when < t);
    if (passed.length) line([...passed.map((knot) => knot.slice(1)), state.atoms[i]]);
  }), 0.7);
  for (const [row, col, depth, holds] of state.tweezers) {
    if (holds) paint("fill", "move", () => dot([row, col], 0.5), 0.35 * Math.min(1, depth));
    paint("stroke", "move", () => dot([row, col], 0.5), Math.min(1, depth), holds ? 0.14 : 0.07);
  }
  const there = scene.atoms.map((_, i) => i).filter((i) => isThere(scene.fates[i], t));
  paint("fill", "atom", () => there.forEach((i) => dot(state.atoms[i], 0.3)));
  paint("stroke", "error", () => there.forEach((i) => ["lost", "missing"].includes(scene.fates[i]?.[0]) && dot(state.atoms[i], 0.3)), 1, 0.13);
  const gone = (fates) => scene.atoms.forEach((_, i) => !isThere(scene.fates[i], t) && fates.includes(scene.fates[i][0]) && cross(state.atoms[i]));
  paint("stroke", "ink-2", () => gone(["ejected"]));
  paint("stroke", "error", () => gone(["lost", "missing"]), 1, 0.14);
}

export function describe(scene, state, t) {
  const n = state.tweezers.length, empty = state.tweezers.filter((one) => !one[3]).length;
  const last = scene.batches.length - 1;
  const where = state.batch > last ? "after the last batch" : `batch ${state.batch} of 0 to ${last}`;
  const lost = scene.fates.filter((fate) => fate && fate[0] !== "ejected" && fate[1] <= t).length;
  return `${t.toFixed(3)} ms, ${where}${n ? `, ${n} tweezer${n > 1 ? "s" : ""}${empty ? `, ${empty} without an atom` : ""}` : ""}${lost ? `, ${lost} lost` : ""}`;
}

// The elements of a player for a scene of labseq.pictures.playback, and functions that draw and play it
export function makePlayer(scene, colour) {
  const make = (tag, props) => Object.assign(document.createElement(tag), props);
  const canvas = make("canvas", {}), caption = make("p", { className: "note" }), extent = extentOf(scene);
  const slider = make("input", { type: "range", min: scene.start, max: scene.end, step: "any", value: scene.start });
  const button = make("button", { type: "button" }), controls = make("div", { className: "player" });
  slider.setAttribute("aria-label", "Time in ms");
  canvas.setAttribute("role", "img");
  controls.append(button, slider);
  let t = scene.start, last = 0, request = 0;
  const draw = () => {
    const state = stateAt(scene, t);
    drawScene(canvas, scene, extent, state, t, colour);
    caption.textContent = describe(scene, state, t);
    canvas.setAttribute("aria-label", caption.textContent);
    button.textContent = request ? "❚❚ Pause" : "▶ Play";
  };
  const stop = () => { cancelAnimationFrame(request); request = 0; };
  const tick = (now) => {
    t = Math.min(scene.end, t + ((now - last) / 1000) * scene.speed);
    [last, slider.value] = [now, t];
    request = t < scene.end && canvas.isConnected ? requestAnimationFrame(tick) : 0;  // its page may have been left
    draw();
  };
  const play = () => {
    if (t >= scene.end) t = scene.start;
    last = performance.now();
    request = requestAnimationFrame(tick);
  };
  button.onclick = () => { if (request) { stop(); draw(); } else play(); };
  slider.oninput = () => { stop(); t = Number(slider.value); draw(); };
  const key = make("p", { className: "note", textContent: KEY });
  return { elements: [canvas, controls, caption, key], draw, play };
}
