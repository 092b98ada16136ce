// One shot: all frames, and its moves cycle by cycle.
import { go } from "./app.js";
import { drawArray, drawFrame } from "./array.js";
import { colour, count, el, facts, getJson, panel, percent, replace, runLink, runPath, table, time } from "./dom.js";
import { makePlayer } from "./player.js";

export async function showShot(main, [day, name, number], asked) {
  const id = `${day}/${name}`, attempt = asked.get("attempt");
  const base = `/runs/${runPath(id)}/shots/${number}`, suffix = attempt === null ? "" : `attempt=${attempt}`;
  const { run, shot } = await getJson(`${base}${suffix ? `?${suffix}` : ""}`);
  document.title = `Shot ${shot.shot}, ${run.name} · labseq`;
  const step = (by) => el("a.button", { href: `/runs/${runPath(id)}/shots/${Math.max(0, shot.shot + by)}`, "aria-label": by < 0 ? "Previous shot" : "Next shot" }, by < 0 ? "←" : "→");
  const outcome = shot.status !== "complete" ? `${shot.status}: ${shot.error}` : shot.success ? "defect-free" : shot.filling === null ? "not judged" : `${percent(shot.filling, 2)} filled`;
  const draws = [];
  replace(main, el("div.title-line", {}, el("h1", {}, `Shot ${shot.shot}`), el("span.tag", {}, outcome), attempt !== null ? el("span.tag", {}, `attempt ${shot.attempt}`) : null, step(-1), step(1)),
    el("div.sub-line", {}, runLink(id), el("span", {}, `${count(shot.images.length, "image")}, ${count(shot.cycles.length, "cycle")}`), el("a", { href: `/api/v1${base}${suffix ? `?${suffix}` : ""}` }, "as JSON")),
    el("div.grid", {}, shot.cycles.length ? cyclesPanel(run, shot, base, suffix, draws) : null, framesPanel(run, shot, base, suffix, draws),
      panel("Stages", { class: "half tall" }, stages(shot)), panel("Readings", { class: "half" }, orNone(shot.readings)), panel("Settings of this shot", { class: "half" }, orNone(shot.parameters)), panel("Calibrations", { class: "half" }, orNone(shot.calibrations))));
  const draw = () => draws.forEach((one) => one());
  draw();
  document.addEventListener("themechange", draw);
  addEventListener("resize", draw);
  const onKey = (event) => {
    if (event.target.closest("input, select, textarea, .scroller") || event.altKey || event.ctrlKey || event.metaKey) return;
    if (event.key === "ArrowLeft" && shot.shot > 0) go(`/runs/${runPath(id)}/shots/${shot.shot - 1}`);
    if (event.key === "ArrowRight") go(`/runs/${runPath(id)}/shots/${shot.shot + 1}`);
  };
  addEventListener("keydown", onKey);
  return () => { document.removeEventListener("themechange", draw); removeEventListener("resize", draw); removeEventListener("keydown", onKey); };
}

function orNone(values) { return Object.keys(values).length ? facts(values) : el("p.hint", {}, "none"); }

function cyclesPanel(run, shot, base, suffix, draws) {
  const figures = shot.cycles.map((cycle, k) => {
    const at = shot.images.findIndex((one) => one.step === cycle.step && one.cycle === cycle.cycle);
    const before = shot.images[at > 0 ? at - 1 : 0], after = shot.images[at], moves = cycle.batches.slice(0, cycle.n_batches_played);
    const canvas = el("canvas", { role: "img" });
    const slider = el("input", { type: "range", min: 0, max: moves.length, value: moves.length, "aria-label": `Batches of cycle ${cycle.cycle}`, oninput: () => draw() });
    const caption = el("figcaption");
    const draw = () => {
      const n = Number(slider.value);
      drawArray(canvas, run.lattice, run.target.fill, before.occupancy, moves, n);
      caption.textContent = `Cycle ${cycle.cycle}: ${count(before.n_defects, "defect")} before${after ? `, ${after.n_defects} after` : ""}; ${n} of ${moves.length} batches, ${count(moves.slice(0, n).flat().length, "move")}, ${time(cycle.moves_s)} of ${time(cycle.window_s)}${cycle.late_s ? `, ${time(cycle.late_s)} late` : ""}`
        + (cycle.n_batches > moves.length ? `; ${cycle.n_batches - moves.length} batches did not fit` : "");
      canvas.setAttribute("aria-label", caption.textContent);
    };
    draws.push(draw);
    const button = el("button.play", { type: "button", onclick: async () => {
      button.disabled = true;
      try {
        const player = makePlayer(await getJson(`${base}/motion/${k}${suffix ? `?${suffix}` : ""}`), colour);
        slider.value = moves.length;
        draw();
        replace(figure, ...player.elements, caption);
        figure.className = "playing";
        draws[draws.indexOf(draw)] = player.draw;
        player.play();
      } catch (error) { replace(button, `cannot be played: ${error.message}`); }
    } }, `▶ Play cycle ${cycle.cycle}`);
    const figure = el("figure", {}, canvas, moves.length > 1 ? slider : null, caption, moves.length ? button : null);
    return figure;
  });
  return panel("Cycle by cycle", { class: "wide" }, el("div.figures.many", {}, figures));
}

function framesPanel(run, shot, base, suffix, draws) {
  const figures = shot.images.map((image, i) => {
    const canvas = el("canvas", { role: "img", "aria-label": `${image.name}: ${count(image.n_atoms, "atom")}` });
    const caption = el("figcaption", {}, `${i}: ${image.name}${image.cycle >= 0 ? `, cycle ${image.cycle}` : ""}: ${count(image.n_atoms, "atom")}${run.target.n_atoms ? `, ${count(image.n_defects, "defect")}` : ""}${image.n_surplus ? `, ${image.n_surplus} surplus` : ""}; at ${time(image.t_start_s)}, ${time(image.exposure_s)}`);
    let bitmap = null, reduced = 1;
    draws.push(() => (image.has_frame ? bitmap && drawFrame(canvas, bitmap, reduced, shot.sites_px, image.occupancy) : drawArray(canvas, run.lattice, run.target.fill, image.occupancy)));
    if (image.has_frame)
      fetch(`/api/v1${base}/frames/${i}.png?width=1024${suffix ? `&${suffix}` : ""}`).then(async (answer) => {
        if (!answer.ok) { caption.textContent += "; its frame cannot be read"; return; }
        reduced = Number(answer.headers.get("x-reduced") ?? 1);
        bitmap = await createImageBitmap(await answer.blob());
        drawFrame(canvas, bitmap, reduced, shot.sites_px, image.occupancy);
      }).catch(() => { caption.textContent += "; its frame cannot be loaded"; });
    return el("figure", {}, canvas, caption);
  });
  return panel("Images", { class: "wide" }, el("div.figures.frames", {}, figures));
}

function stages(shot) {
  const heads = ["stage", { text: "step", right: true }, { text: "cycle", right: true }, { text: "start", right: true }, { text: "time", right: true }, { text: "host", right: true }, { text: "budget", right: true }];
  return table(heads, shot.stages.map((one) => ({ mark: one.over ? "is-over" : "", cells: [one.stage, String(one.step), one.cycle < 0 ? "" : String(one.cycle), time(one.t_start_s), time(one.duration_s), time(one.host_s), one.budget_s ? time(one.budget_s) : "–"] })), { label: "Stages" });
}
