// What is known of each rig, built from the live stream: survives changing views, rebuilt on reload.
import { get } from "./api.js";
import * as stream from "./stream.js";

const rigs = new Map();   // name -> {job, progress, campaign, free, point, review, conditions: Map, window, log: [], fresh, levels, spectrum, waveform}
const jobs = new Map();
const watchers = new Set();
let queued = false;

export function of(name) {
  if (!rigs.has(name)) rigs.set(name, fresh());
  return rigs.get(name);
}
function fresh() { return { job: null, progress: 0, campaign: null, free: null, point: null, review: null, conditions: new Map(), window: null, current: null, log: [], outcome: null, fresh: false }; }

// whether a rig's pictures are of now: seen since the connection stands, of work that moves on
export function isLive(name) {
  const rig = of(name);
  return rig.fresh && [...jobs.values()].some((one) => one.about.rig === name && one.state === "running" && one.hold !== "paused" && !(one.id === rig.job && rig.outcome));
}

export const job = (id) => jobs.get(id);
export const anyRunning = () => [...jobs.values()].some((one) => one.state === "running" && one.about.rig);
export function watch(listener) { watchers.add(listener); return () => watchers.delete(listener); }
function changed() {
  if (queued) return;
  queued = true;
  requestAnimationFrame(() => { queued = false; for (const listener of watchers) listener(); });
}

function forRig(event) {
  const name = event.data?.rig ?? event.rig;
  return name ? of(name) : null;
}

export function start() {
  stream.on("restarted", () => { rigs.clear(); jobs.clear(); changed(); });
  stream.on("resumed", async () => {
    // What ran before the silence may be over: only what is said from here on counts.
    jobs.clear();
    for (const rig of rigs.values()) rig.fresh = false;
    try { for (const one of (await get("/jobs", { limit: 100 })).items) if (!jobs.has(one.id)) jobs.set(one.id, one); } catch { /* the next job event brings them */ }
    changed();
  });
  stream.on("job", ({ data }) => {
    jobs.set(data.id, data);
    if (data.about.rig && data.kind !== "watch" && data.state === "running") {
      const rig = of(data.about.rig);
      if (rig.job !== data.id) rigs.set(data.about.rig, { ...fresh(), job: data.id, campaign: data.about.campaign, levels: rig.levels });
    }
    if (data.about.rig && data.state !== "running") of(data.about.rig).fresh = false;
    changed();
  });
  stream.on("progress", ({ data }) => {
    const one = jobs.get(data.job);
    if (one) Object.assign(one, { progress: data.progress, message: data.message });
    if (data.rig && of(data.rig).job === data.job) of(data.rig).progress = data.progress;
    changed();
  });
  stream.on("log", ({ data, time }) => {
    const rig = data.rig ? of(data.rig) : null;
    if (rig) { rig.log.push(`${time.slice(11, 19)} ${data.text}`); if (rig.log.length > 400) rig.log.shift(); changed(); }
  });
  stream.on("campaign", (event) => {
    const rig = forRig(event), { kind, index, data } = event.data;
    if (!rig) return;
    if (kind === "started") Object.assign(rig, { conditions: new Map(), outcome: null });
    if (kind === "free") rig.free = data;
    if (kind === "operating_point") rig.point = data;
    if (kind === "review") rig.review = data;
    if (kind === "condition") { rig.current = { index, ...data }; rig.conditions.set(index, { ...data, state: "approaching" }); }
    if (kind === "window") {
      rig.window = data;
      const known = rig.conditions.get(index) || {};
      rig.conditions.set(index, { ...known, frequency_hz: data.frequency_hz, drive_v: data.drive_v, threshold_v: data.threshold_v ?? known.threshold_v, state: "approaching" });
    }
    if (kind === "recorded" || kind === "not_entrained" || kind === "skipped") {
      const known = rig.conditions.get(index) || {};
      rig.conditions.set(index, { ...known, ...data, drive_v: data.amplitude_v ?? known.drive_v, state: kind === "recorded" ? data.status : kind });
    }
    if (kind === "finished" || kind === "failed") { rig.outcome = { kind, ...data }; rig.window = null; rig.current = null; }
    changed();
  });
  for (const kind of ["levels", "waveform", "spectrum"]) {
    stream.on(kind, (event) => {
      const rig = forRig(event);
      if (rig) { Object.assign(rig, { fresh: true, [kind]: kind === "levels" ? event.data : event }); changed(); }
    });
  }
  for (const kind of ["control", "emergency_stop", "reset"]) stream.on(kind, changed);
}
