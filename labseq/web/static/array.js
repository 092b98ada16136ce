// Draws the array: sites, atoms, defects and moves; and frames with their sites.
import { colour } from "./dom.js";
import { prepared } from "./player.js";

export function positions(lattice) {
  const found = [], shift = lattice.kind === "square" ? 0 : 0.5 * lattice.shear, height = lattice.kind === "square" ? 1 : Math.sqrt(3) / 2;
  for (let row = 0; row < lattice.rows; row++)
    for (let col = 0; col < lattice.cols; col++) found.push([col + row * shift, row * height]);
  return found;
}

// occupancy, fill: texts of 0 and 1 per row; batches: lists of [row, col, row, col]
export function drawArray(canvas, lattice, fill, occupancy, batches = [], upTo = Infinity) {
  const at = positions(lattice);
  const xs = at.map((p) => p[0]), ys = at.map((p) => p[1]);
  const low = [Math.min(...xs) - 1, Math.min(...ys) - 1], size = [Math.max(...xs) - low[0] + 1, Math.max(...ys) - low[1] + 1];
  const [ctx, width] = prepared(canvas, size[1] / size[0]);
  const unit = width / size[0], place = (i) => [(at[i][0] - low[0]) * unit, (at[i][1] - low[1]) * unit];
  const atom = colour("atom"), bad = colour("warn"), site = colour("site"), goal = colour("goal");
  const dot = (i, r) => { const [x, y] = place(i); ctx.moveTo(x + r, y); ctx.arc(x, y, r, 0, 2 * Math.PI); };
  const each = (test, draw) => { ctx.beginPath(); at.forEach((_, i) => test(i) && draw(i)); };
  const has = (rows, i) => rows[Math.floor(i / lattice.cols)]?.[i % lattice.cols] === "1";

  ctx.fillStyle = goal;
  each((i) => has(fill, i), (i) => dot(i, 0.52 * unit));
  ctx.fill();
  ctx.fillStyle = site;
  each((i) => !has(occupancy, i), (i) => dot(i, Math.max(0.6, 0.09 * unit)));
  ctx.fill();
  ctx.fillStyle = atom;
  each((i) => has(occupancy, i), (i) => dot(i, 0.3 * unit));
  ctx.fill();
  ctx.strokeStyle = bad;
  ctx.lineWidth = Math.max(1.2, 0.13 * unit);
  each((i) => has(fill, i) && !has(occupancy, i), (i) => {
    const [x, y] = place(i), r = 0.34 * unit;
    ctx.moveTo(x - r, y - r); ctx.lineTo(x + r, y + r); ctx.moveTo(x - r, y + r); ctx.lineTo(x + r, y - r);
  });
  ctx.stroke();
  drawMoves(ctx, lattice, batches.slice(0, upTo), unit, low);
}

function drawMoves(ctx, lattice, batches, unit, low) {
  const shift = lattice.kind === "square" ? 0 : 0.5 * lattice.shear, height = lattice.kind === "square" ? 1 : Math.sqrt(3) / 2;
  const place = (row, col) => [(col + row * shift - low[0]) * unit, (row * height - low[1]) * unit];
  ctx.strokeStyle = ctx.fillStyle = colour("move");
  ctx.lineWidth = Math.max(1, 0.09 * unit);
  ctx.lineCap = "round";
  batches.forEach((batch, k) => {
    ctx.globalAlpha = batches.length > 6 ? 0.35 + 0.5 * (k + 1) / batches.length : 0.9;
    for (const [r0, c0, r1, c1] of batch) {
      const [x0, y0] = place(r0, c0), [x1, y1] = place(r1, c1), angle = Math.atan2(y1 - y0, x1 - x0), head = Math.min(0.42 * unit, 7);
      ctx.beginPath();
      ctx.moveTo(x0, y0);
      ctx.lineTo(x1 - 0.5 * head * Math.cos(angle), y1 - 0.5 * head * Math.sin(angle));
      ctx.stroke();
      ctx.beginPath();
      ctx.moveTo(x1, y1);
      ctx.lineTo(x1 - head * Math.cos(angle - 0.5), y1 - head * Math.sin(angle - 0.5));
      ctx.lineTo(x1 - head * Math.cos(angle + 0.5), y1 - head * Math.sin(angle + 0.5));
      ctx.fill();
    }
  });
  ctx.globalAlpha = 1;
}

export function drawFrame(canvas, bitmap, reduced, sites, occupancy) {
  if (!bitmap) { prepared(canvas, 0.6); return; }
  const [ctx, width] = prepared(canvas, bitmap.height / bitmap.width);
  // the array alone, if its sites are known: frames are mostly empty
  let box = [0, 0, bitmap.width, bitmap.height];
  if (sites) {
    const flat = sites.flat(), ys = flat.map((p) => p[0] / reduced), xs = flat.map((p) => p[1] / reduced);
    const pad = 0.06 * Math.max(Math.max(...xs) - Math.min(...xs), 16);
    const x0 = Math.max(0, Math.min(...xs) - pad), y0 = Math.max(0, Math.min(...ys) - pad);
    box = [x0, y0, Math.min(bitmap.width, Math.max(...xs) + pad) - x0, Math.min(bitmap.height, Math.max(...ys) + pad) - y0];
    prepared(canvas, box[3] / box[2]);
  }
  const scale = width / box[2];
  const [a, b] = [sites?.[0]?.[0], sites?.[0]?.[1] ?? sites?.[1]?.[0]];  // neighbours
  const radius = a && b ? Math.max(2, 0.34 * Math.hypot(a[0] - b[0], a[1] - b[1]) / reduced * scale) : 4;
  ctx.imageSmoothingEnabled = scale < 1;
  ctx.drawImage(bitmap, box[0], box[1], box[2], box[3], 0, 0, width, box[3] * scale);
  if (!sites) return;
  ctx.lineWidth = 1;
  ctx.strokeStyle = "rgba(120, 200, 255, 0.75)";
  ctx.beginPath();
  sites.forEach((row, r) => row.forEach(([y, x], c) => {
    if (occupancy[r]?.[c] !== "1") return;
    const [px, py] = [(x / reduced + 0.5 / reduced - box[0]) * scale, (y / reduced + 0.5 / reduced - box[1]) * scale];
    ctx.moveTo(px + radius, py);
    ctx.arc(px, py, radius, 0, 2 * Math.PI);
  }));
  ctx.stroke();
}
