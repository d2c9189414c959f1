// Live: what the rig does now, against its limits; steering; the tongue as it fills up.
import { attempt, controlToken, get, keepToken, post, api } from "../api.js";
import { card, h, num, table, unit, withError } from "../dom.js";
import * as model from "../model.js";
import { Curves, Portrait, scatter } from "../plot.js";
import * as stream from "../stream.js";

export default async function live([wanted]) {
  const list = await get("/rigs");
  const running = list.find((rig) => ["running", "paused"].includes(rig.state));
  const name = wanted || running?.name || list[0]?.name;
  if (!name) return { title: "Live", content: h("p", {}, "No rig is configured. Add a simulated one under Rigs.") };
  if (!list.some((rig) => rig.name === name)) {
    const others = list.flatMap((rig, i) => [i ? ", " : "", h("a", { href: `#live/${rig.name}` }, rig.name)]);
    return { title: "Live", content: h("p", {}, `No rig is called ${name}. `, list.length ? "There is " : "Add one under Rigs.", ...others) };
  }

  const picker = h("select", { "aria-label": "Rig", onchange: (e) => { location.hash = `live/${e.target.value}`; } },
    list.map((rig) => h("option", { value: rig.name, selected: rig.name === name }, rig.name)));
  const state = h("div", { class: "row", role: "status" });
  const progress = h("progress", { max: "1", value: "0", "aria-label": "Campaign's progress" });
  const message = h("p", { class: "soft" }, "");
  const steer = (command) => attempt(() => post(`/jobs/${rigJob()}/${command}`, {}, name));
  const rigJob = () => { const one = current(); return one?.id; };
  const current = () => [...[model.of(name).job].map(model.job)].find((one) => one && (one.state === "running" || one.state === "queued"));
  const buttons = {
    pause: h("button", { type: "button", title: "Silence the speaker at the next window, and wait", onclick: () => steer("pause") }, "Pause"),
    resume: h("button", { type: "button", onclick: () => steer("resume") }, "Resume"),
    skip: h("button", { type: "button", onclick: () => steer("skip") }, "Skip condition"),
    stop: h("button", { type: "button", class: "danger", onclick: () => steer("stop") }, "End campaign"),
  };
  const watch = h("button", { type: "button", onclick: () => attempt(() => post(`/rigs/${name}/watch`, { seconds: 60 }, name), "watching for a minute") }, "Watch for a minute");
  const control = h("button", { type: "button", onclick: toggleControl }, "Take control");
  const reset = h("button", { type: "button", class: "primary", hidden: true, onclick: () => attempt(() => post(`/rigs/${name}/reset`, {}, name), "output is allowed again").then(refresh) }, "Reset stop");

  async function toggleControl() {
    if (controlToken(name)) {
      await attempt(() => api("DELETE", `/rigs/${name}/lock`, { rig: name }), "control given back");
      keepToken(name, null);
    } else {
      const takeover = Boolean(facts.holder);
      if (takeover && !confirm(`${facts.holder} has control of ${name}. Take it over?`)) return;
      const lock = await attempt(() => post(`/rigs/${name}/lock`, { takeover }, name), "you have control");
      if (lock) keepToken(name, lock.token);
    }
    refresh();
  }

  const meters = h("div", {});
  const gauge = h("div", { class: "meter", role: "meter", "aria-label": "Limit cycle below its free level, dB", "aria-valuemin": "-60", "aria-valuemax": "0" }, h("i"), h("b", { hidden: true }));
  const gaugeText = h("div", { class: "big" }, "–");
  const gaugeNote = h("p", { class: "soft" });
  const values = h("dl", {});
  const wave = new Curves({ label: "Waveform of the pressure channels", x: "time (ms)", y: "Pa", series: [{ label: "p1", colour: "--c1" }, { label: "p2", colour: "--c2" }] });
  const rig = () => model.of(name);
  const spectrum = new Curves({
    label: "Spectrum of the pressure channels with the limit cycle and forcing lines marked", x: "frequency (Hz)", y: "dB re 1 Pa", height: 260,
    series: [{ label: "p1", colour: "--c1" }, { label: "p2", colour: "--c2" }],
    marks: () => [
      { x: rig().free?.frequency_hz, label: "limit cycle", colour: "--c3", row: 1 },
      { x: rig().window?.frequency_hz ?? rig().current?.frequency_hz, label: "forcing", colour: "--c4", row: 2 }],
  });
  const portrait = new Portrait("Phase portrait: the first pressure channel against itself a quarter of a period earlier");
  const tongue = h("div", {});
  const tongueText = h("p", { class: "soft" }, "");
  const fitText = h("p", { class: "soft" }, ""), fitTable = h("div", {});
  const fit = card("", "Fit so far", fitText, fitTable);
  const log = h("div", { class: "log", role: "log", "aria-label": "Campaign's log", tabindex: "0" });
  // pictures of the moment, grey when that is past
  const liveCard = (width, label, heading, ...parts) => h("section", { class: `card ${width} livecard`, "aria-label": label }, h("h2", {}, heading), ...parts);
  const pictures = [
    liveCard("w4", "Criterion", "Limit cycle against its free level", gaugeText, gauge, gaugeNote, values),
    liveCard("w8", "Spectrum", "Spectrum", spectrum.root),
    liveCard("w4", "Levels", "Levels against limits", meters),
    liveCard("w5", "Waveform", "Waveform", wave.root),
    liveCard("w3", "Phase portrait", "Phase portrait", portrait.canvas)];
  let facts = list.find((one) => one.name === name) || {}, logged = 0, tongueKey = "", fitted = null;

  async function refresh() {
    try { facts = await get(`/rigs/${name}`); } catch { return; }
    draw();
  }

  function draw() {
    const seen = rig(), job = current(), moves = job?.state === "running";
    const mine = Boolean(controlToken(name));
    state.replaceChildren(
      h("span", { class: `chip ${facts.state === "stopped" ? "bad" : job?.hold ? "warn" : moves ? "good" : ""}` }, facts.state === "stopped" ? `stopped by ${facts.stopped_by}` : job ? job.hold || job.state : "idle"),
      h("span", { class: "chip" }, facts.holder ? `control: ${mine ? "you" : facts.holder}` : "control: free"),
      facts.queued ? h("span", { class: "chip" }, `${facts.queued} waiting`) : "");
    control.textContent = mine ? "Give control back" : "Take control";
    reset.hidden = facts.state !== "stopped";
    buttons.stop.disabled = !job;
    buttons.skip.disabled = !moves;
    buttons.pause.disabled = !moves || Boolean(job.hold);
    buttons.resume.disabled = !job?.hold;
    watch.disabled = Boolean(job);
    progress.value = job?.progress ?? seen.progress;
    message.replaceChildren(job?.hold === "pausing" ? "pausing at the next window" : job?.hold ? "paused: the speaker is silent until you resume" : job ? job.message || job.title : seen.outcome ? `campaign ${seen.outcome.status ?? seen.outcome.kind} ${seen.outcome.reason || ""}` : "no campaign is running", " ",
      seen.campaign ? h("a", { href: `#campaign/${seen.campaign}` }, "open the campaign") : "");
    const past = Boolean(seen.levels || seen.waveform) && !model.isLive(name);
    for (const picture of pictures) picture.classList.toggle("past", past);
    drawLevels(seen.levels);
    drawGauge(seen);
    drawWave(seen.waveform);
    drawSpectrum(seen.spectrum);
    drawTongue(seen);
    drawFit(seen.review);
    if (logged !== seen.log.length) {
      log.textContent = seen.log.slice(-200).join("\n");
      log.scrollTop = log.scrollHeight;
      logged = seen.log.length;
    }
  }

  function drawLevels(levels) {
    if (!levels) { meters.replaceChildren(h("p", { class: "soft" }, "No signal: start a campaign, or watch.")); return; }
    const rows = levels.channels.map((one) => bar(one.name, one.of_full_scale, `${num(one.rms, 3)} ${one.unit} rms`));
    rows.push(bar("output", levels.output_v / levels.limit_v, `${num(levels.output_v, 3)} of ${num(levels.limit_v, 3)} V`));
    meters.replaceChildren(...rows,
      h("p", { class: levels.lost_frames ? "bad" : "soft" }, `${levels.lost_frames} of ${levels.frames} frames lost${levels.muted ? `; muted: ${levels.muted}` : ""}${levels.fault ? `; ${levels.fault}` : ""}`));
  }
  function bar(label, share, text) {
    const percent = Math.min(100, Math.max(0, 100 * share));
    return h("div", { class: "level" }, h("div", { class: "row" }, h("span", {}, label), h("span", { class: "soft" }, text), h("span", { class: "spacer" }), h("span", { class: "soft" }, `${percent.toFixed(0)} %`)),
      h("div", { class: `meter ${share > 0.95 ? "hot" : share > 0.8 ? "warm" : ""}`, role: "meter", "aria-label": `${label}, share of its limit`, "aria-valuemin": "0", "aria-valuemax": "100", "aria-valuenow": percent.toFixed(0) }, h("i", { style: `width:${percent}%` })));
  }
  function drawGauge(seen) {
    const level = seen.window?.suppression_db;
    const criterion = seen.window?.criterion_db, reach = Math.max(60, 1.25 * (criterion ?? 0));
    const shown = level === undefined || level === null ? null : Math.max(-reach, Math.min(0, level));
    gauge.firstChild.style.width = shown === null ? "0" : `${100 * -shown / reach}%`;
    gauge.lastChild.hidden = criterion === undefined;
    gauge.lastChild.style.left = `${100 * (criterion ?? 0) / reach}%`;
    gauge.setAttribute("aria-valuemin", String(-reach));
    gauge.setAttribute("aria-valuenow", shown === null ? "0" : shown.toFixed(1));
    gaugeText.textContent = shown === null ? "–" : `${level.toFixed(1)} dB`;
    gaugeText.className = `big ${shown !== null && level <= -criterion ? "good" : ""}`;
    gaugeNote.textContent = criterion === undefined ? "how far the drive keeps it below its free level" : `entrained when at least ${num(criterion)} dB below its free level`;
    const pairs = [
      ["free limit cycle", seen.free ? `${num(seen.free.frequency_hz, 6)} Hz, ${num(seen.free.amplitude)} Pa` : "–"],
      ["forcing", seen.window ? `${num(seen.window.frequency_hz, 6)} Hz at ${num(seen.window.drive_v, 3)} V` : "–"],
      ["phase", seen.window ? `${num(seen.window.phase_deg, 3)}° (${seen.window.phase})` : "–"],
      ["threshold", seen.window?.threshold_v ? `${seen.window.threshold_sigma_v ? withError(seen.window.threshold_v, seen.window.threshold_sigma_v) : num(seen.window.threshold_v, 3)} V` : "–"],
      ...(seen.point ? [["operating point", pointText(seen.point)]] : [])];
    values.replaceChildren(...pairs.flatMap(([k, v]) => [h("dt", {}, k), h("dd", {}, v)]));
  }
  const pointText = ({ point, name: called, ...reached }) => [`${point} ${called || ""}`.trim(), ...Object.entries(reached).map(([k, v]) => `${k} ${num(v)}`)].join(", ");
  function drawFit(found) {
    fit.hidden = !found;
    if (!found || found === fitted) return;
    fitted = found;
    if (!found.parameters) { fitText.textContent = `after ${found.runs} runs: ${found.reason || "not converged"}`; return; }
    const missing = Object.keys(found.missing).length;
    fitText.textContent = `after ${found.runs} forced runs: χ²/dof ${num(found.chi2_per_dof, 3)}${found.converged ? "" : ", not converged"}${missing ? `; ${missing} not yet as precise as wanted` : ""}`;
    fitTable.replaceChildren(table("Parameters so far", ["parameter", "value ± standard error", "unit", "relative", ""], Object.entries(found.parameters).map(([key, p]) => {
      const share = found.relative_error[key];
      return [key, withError(p.value, p.stderr), unit(p.unit), share === null ? "undetermined" : `${num(100 * share, 2)} %`, key in found.missing ? "not yet" : ""];
    }), { numeric: [3] }));
  }
  function drawWave(event) {
    if (!event) { wave.set([[], [], []]); portrait.clear(); return; }
    const [rows, columns] = event.shape, pressure = event.channels.map((c, i) => i).filter((i) => event.units[i] === "Pa").slice(0, 2);
    const time = Float64Array.from({ length: rows }, (_, i) => 1000 * i / event.rate_hz);
    const pick = (c) => Float64Array.from({ length: rows }, (_, i) => event.samples[i * columns + c]);
    const chosen = pressure.length === 2 ? pressure : [0, Math.min(1, columns - 1)];
    const [a, b] = chosen.map(pick);
    wave.set([time, a, b]);
    const beat = rig().window?.frequency_hz ?? rig().free?.frequency_hz ?? 170;
    const lag = Math.max(1, Math.round(event.rate_hz / beat / 4));
    portrait.draw([...a.slice(lag)], [...a.slice(0, -lag)], event.channels[chosen[0]], event.units[chosen[0]]);
  }
  function drawSpectrum(event) {
    if (!event) { spectrum.set([[], [], []]); return; }
    const [rows, columns] = event.shape;
    const frequency = Float64Array.from({ length: rows }, (_, i) => i * event.step_hz);
    spectrum.set([frequency, ...[0, Math.min(1, columns - 1)].map((c) => Float64Array.from({ length: rows }, (_, i) => event.samples[i * columns + c]))]);
  }
  function drawTongue(seen) {
    const points = [];
    for (const [index, one] of seen.conditions) {
      if (!one.frequency_hz || one.cold || one.kind === "cold") continue;
      const what = `condition ${index}: ${num(one.frequency_hz, 6)} Hz, ${num(one.drive_v, 3)} V, ${one.state}`;
      if (one.threshold_v) points.push({ x: one.frequency_hz, y: one.threshold_v, colour: "--c1", hollow: true, label: `condition ${index}: threshold ${num(one.threshold_v, 3)} V` });
      if (one.drive_v > 0) points.push({ x: one.frequency_hz, y: one.drive_v, colour: one.state === "entrained" ? "--good" : one.state === "approaching" ? "--warn" : "--bad", cross: !["entrained", "approaching"].includes(one.state), label: what });
    }
    const key_ = JSON.stringify(points) + seen.free?.frequency_hz;
    if (key_ === tongueKey) return;
    tongueKey = key_;
    const lines = seen.free ? [{ points: [[seen.free.frequency_hz, 0], [seen.free.frequency_hz, Math.max(0.1, ...points.map((p) => p.y))]], colour: "--c3", dash: true, label: "limit cycle" }] : [];
    if (!points.length && !lines.length) tongue.replaceChildren();
    else tongue.replaceChildren(scatter({ label: "Lock-in tongue: drive against frequency", x: "forcing frequency (Hz)", y: "drive (V)", points, lines, width: 400, height: 250 }));
    const done = [...seen.conditions.values()].filter((one) => one.state === "entrained").length;
    tongueText.textContent = points.length ? `${done} entrained; filled: recorded, ring: threshold, cross: not entrained, dashed: limit cycle` : "fills up as the campaign proceeds";
  }

  const stopWatching = model.watch(draw);
  const timer = setInterval(refresh, 3000);
  const ears = ["job", "emergency_stop", "reset", "control", "resumed"].map((kind) => stream.on(kind, refresh));
  const content = h("div", { class: "grid" },
    card("w8", "Rig", h("div", { class: "row" }, picker, state, h("span", { class: "spacer" }), control, reset, watch), h("p", {}), progress, message, h("div", { class: "row" }, Object.values(buttons))),
    ...pictures,
    liveCard("w4", "Tongue", "Lock-in tongue", tongue, tongueText),
    fit, card("", "Log", log));
  draw();
  return { title: `Live: ${name}`, content, close: () => { stopWatching(); clearInterval(timer); for (const deaf of ears) deaf(); } };
}
