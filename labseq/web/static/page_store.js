// The queue, and the calibrations.
import { server } from "./app.js";
import { curve } from "./charts.js";
import { el, failure, getJson, localTime, panel, post, replace, runLink, statusPill, table } from "./dom.js";

export async function showQueue(main) {
  const list = el("div"), adding = el("div"), note = el("p.note", { role: "status" });
  const act = async (path, values) => {
    try { const answer = await post(path, values); note.textContent = answer.done; } catch (error) { note.textContent = error.message; }
    await load();
  };
  let before = "";
  async function load() {
    try {
      const queue = await getJson("/queue"), now = JSON.stringify(queue);
      if (now === before) return;
      before = now;
      replace(list, queue.error ? failure(new Error(queue.error)) : null, el("p.note", {}, queue.run_by ? `run by: ${queue.run_by}` : "no process runs the queue: start labseq queue run", queue.is_paused ? "; paused" : ""),
        queue.entries.length ? entries(queue.entries, act) : el("p.hint", {}, "The queue is empty."),
        server.may_act ? el("button", { type: "button", onclick: () => act("/queue/pause", { paused: !queue.is_paused }) }, queue.is_paused ? "Continue the queue" : "Pause the queue") : null);
    } catch (error) { before = ""; replace(list, failure(error)); }
  }
  replace(main, el("h1", {}, "Queue"), note, el("div.grid", {}, panel("What is next", { class: "wide" }, list), server.may_act ? panel("Queue a sequence", { class: "wide" }, adding) : null));
  await load();
  if (server.may_act) await addForm(adding, act);
  const again = setInterval(() => { if (!document.hidden) load(); }, 2000);
  return () => clearInterval(again);
}

const AHEAD = ["running", "interrupted", "waiting"], EARLY = ["stopped", "failed", "skipped"];

function entries(all, act) {
  const heads = [{ text: "id", right: true }, "state", "sequence", { text: "begun", line: true }, { text: "ends", line: true }, "changed values and rules", "run", ...(server.may_act ? ["order"] : [])];
  return table(heads, all.map((one, i) => {
    const changed = [...Object.entries(one.options).map(([k, v]) => `${k} = ${v}`), ...one.rules].join(", ");
    const ends = one.ends_utc ? `${AHEAD.includes(one.state) ? "about " : ""}${localTime(one.ends_utc)}` : "–";
    return [String(one.id), statusPill(one.state), el("span", { title: one.path }, one.sequence, one.error ? el("small.reason", {}, one.error) : null), one.begun_utc ? localTime(one.begun_utc) : "–", ends, changed || "–",
      one.run ? runLink(one.run) : "–", ...(server.may_act ? [orderButtons(all, i, act)] : [])];
  }), { label: "Entries of the queue" });
}

function orderButtons(all, i, act) {
  const one = all[i];
  if (one.state === "complete") return "";
  const button = (text, label, path, values, disabled = false) => el("button.quiet", { type: "button", disabled, "aria-label": `${label} entry ${one.id}`, onclick: () => act(path, values) }, text);
  const isFirst = i === 0 || all[i - 1].state === "complete";
  return el("span", {},
    isFirst ? null : button("↑", "Move up", "/queue/move", { entry: one.id, before: all[i - 1].id }),
    i === all.length - 1 ? null : button("↓", "Move down", "/queue/move", { entry: all[i + 1].id, before: one.id }),
    EARLY.includes(one.state) ? button("resume", "Resume", "/queue/resume", { entry: one.id }) : null,
    one.state === "running" ? null : button("remove", "Remove", "/queue/remove", { entry: one.id }));
}

async function addForm(box, act) {
  const { sequences } = await getJson("/sequences");
  const fields = el("div.fields");
  const choose = el("select", { "aria-label": "Sequence", onchange: () => load() }, el("option", { value: "" }, "choose a sequence"), sequences.map((one) => el("option", { value: one }, one)));
  let inputs = [];
  async function load() {
    if (!choose.value) { replace(fields); return; }
    replace(fields, el("p.hint", {}, "reading the schema ..."));
    try {
      const form = await getJson(`/sequences/${encodeURIComponent(choose.value)}`);
      inputs = form.fields.map(field);
      const profile = el("input", { id: "profile", placeholder: String(form.profile ?? "") });
      const add = el("button", { type: "button", onclick: async () => {
        const changes = Object.fromEntries(inputs.filter(({ input, given }) => input.value !== given).map(({ input, address }) => [address, input.value]));
        add.disabled = true;
        await act("/queue/add", { sequence: choose.value, changes, profile: profile.value });
        add.disabled = false;
      } }, "Check and queue it");
      replace(fields, el("label.field", {}, el("span", {}, "profile"), profile), inputs.filter((one) => one.isGiven).map((one) => one.node),
        el("details", {}, el("summary", {}, "values that the sequence leaves at their defaults"), el("div.fields", {}, inputs.filter((one) => !one.isGiven).map((one) => one.node))), add);
    } catch (error) { replace(fields, failure(error)); }
  }
  replace(box, el("div.tools", {}, choose), fields);
}

function field(one) {
  const limits = { placeholder: one.default, title: one.about };
  const input = one.choices.length ? el("select", limits, el("option", { value: "" }, one.default ? `(${one.default})` : ""), one.choices.map((choice) => el("option", { value: choice, selected: choice === one.value }, choice))) : el("input", { ...limits, value: one.value });
  const range = one.min !== undefined && one.max !== undefined ? ` (${one.min} to ${one.max})` : "";
  return { address: one.address, given: one.value, isGiven: one.value !== "", input, node: el("label.field", {}, el("span", {}, one.address), input, el("small", {}, one.about + range)) };
}

export async function showCalibrations(main) {
  const { stores } = await getJson("/calibrations");
  replace(main, el("h1", {}, "Calibrations"), stores.length ? null : el("p.hint", {}, "There are no calibrations of the profiles in ./hardware_profiles or of the latest runs yet."));
  for (const store of stores) {
    const grid = el("div.grid");
    main.append(el("h2.store", {}, store.profile), el("p.note", {}, store.folder), store.error ? failure(new Error(store.error)) : "", grid);
    for (const kind of store.kinds) grid.append(kindPanel(store, kind));
    store.kinds.forEach((kind, i) => drawTrend(grid.children[i], kind));
  }
}

function kindPanel(store, kind) {
  const newest = [...kind.entries].reverse().find((one) => one.has_picture), used = kind.entries.find((one) => one.in_use);
  const picture = el("img.picture", { alt: newest ? `picture of ${kind.kind} ${newest.id}` : "", hidden: !newest, src: newest ? address(store, used?.has_picture ? used : newest) : null });
  const rows = [...kind.entries].reverse().slice(0, 50).map((one) => ({ mark: one.in_use ? "is-used" : "", cells: [
    one.has_picture ? el("button.quiet", { type: "button", onclick: () => { picture.src = address(store, one); picture.alt = `picture of ${kind.kind} ${one.id}`; } }, one.id) : one.id,
    localTime(one.taken_utc), one.error ? "damaged" : one.figure === null ? "–" : Number(one.figure.toPrecision(3)).toString(), one.in_use ? "in use" : "", one.run || "–"] }));
  return panel(kind.kind, { class: "half" }, el("div.chart"), picture, table(["id", "taken", { text: kind.figure || "quality", right: true }, "", "from"], rows, { label: `Calibrations of ${kind.kind}` }));
}

const address = (store, one) => `/api/v1/calibrations/${store.key}/${encodeURIComponent(one.file)}.png`;

function drawTrend(box, kind) {
  const points = kind.entries.filter((one) => one.figure !== null && one.figure !== undefined && one.taken_utc).map((one) => ({ x: new Date(one.taken_utc).getTime() / 1000, y: one.figure, text: `${localTime(one.taken_utc)} (${one.id})` }));
  const chart = box.querySelector(".chart");
  if (points.length < 2) { chart.hidden = true; return; }
  curve(chart, points, { x: "", label: kind.figure, format: (v) => Number(v.toPrecision(3)).toString(), ink: "blue", isTime: true, lowest: 0, height: () => 150 });
}
