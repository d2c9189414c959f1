// One campaign: its card, its runs, and what can be done with it.
import { attempt, download, get, post } from "../api.js";
import { card, h, num, table } from "../dom.js";
import { scatter } from "../plot.js";

export default async function campaign([id]) {
  const one = await get(`/campaigns/${id}`);
  const jobs = (await get("/jobs", { limit: 200 })).items.filter((job) => job.about.campaign === id && ["identification", "diagnosis", "close_loop"].includes(job.kind));
  const go = async (kind) => {
    const job = await attempt(() => post(`/campaigns/${id}/${kind}`));
    if (job) location.hash = `result/${job.id}`;
  };
  const resume = async () => {
    const job = await attempt(() => post(`/campaigns/${id}/resume`, {}, one.rig), "campaign queued");
    if (job) location.hash = `live/${one.rig}`;
  };
  const save = async (event) => {
    const button = event.target;
    button.disabled = true;
    const job = await attempt(() => post(`/campaigns/${id}/exports`), "the export is being written");
    let state = job?.state;
    while (["queued", "running"].includes(state)) {
      await new Promise((resolve) => setTimeout(resolve, 500));
      state = (await attempt(() => get(`/jobs/${job.id}`)))?.state;
    }
    if (state) await attempt(() => download(`/exports/${job.id}`, `${id}.zip`));
    button.disabled = false;
  };
  const facts = [["title", one.title], ["rig", one.rig || "imported"], ["created", one.created_at], ["status", one.status], ["verdict", one.verdict || "not diagnosed"],
    ["declared model", Object.entries(one.declared_model).map(([k, v]) => `${k} ${v}`).join(", ")], ["medium", Object.entries(one.medium).map(([k, v]) => `${k} ${v}`).join(", ")], ["source", one.source || "–"]];
  const points = one.runs.filter((r) => r.kind === "forced").map((r) => ({ x: r.frequency_hz, y: r.amplitude_v, colour: r.role === "validation" ? "--c2" : "--c1", hollow: r.role === "validation", cross: r.exit_status !== "success", label: `${r.name}: ${r.role}, ${r.exit_status}` }));
  return { title: one.title, content: h("div", { class: "grid" },
    card("w7", "Campaign", h("dl", {}, facts.flatMap(([k, v]) => [h("dt", {}, k), h("dd", {}, v)])), h("p", {}),
      h("div", { class: "row" },
        h("button", { type: "button", class: "primary", id: "diagnose", onclick: () => go("diagnoses") }, "Diagnose"),
        h("button", { type: "button", id: "identify", onclick: () => go("identifications") }, "Identify"),
        h("button", { type: "button", id: "export", onclick: save }, "Export as zip"),
        one.rig && one.status !== "complete" ? h("button", { type: "button", onclick: resume }, "Go on with it") : ""),
      jobs.length ? h("p", {}, "Results: ", jobs.map((job) => [h("a", { href: `#result/${job.id}` }, `${job.kind.replace("_", " ")} ${job.state}, ${job.created.slice(0, 19).replace("T", " ")}`), " "])) : ""),
    card("w5", "Conditions", points.length ? scatter({ label: "Drive against frequency of every forced run", x: "frequency (Hz)", y: "drive (V)", points, height: 240 }) : h("p", {}, "no forced run"), h("p", { class: "soft" }, "filled: fit, ring: validation, cross: not successful")),
    card("", "Runs", table("", ["run", "kind", "role", "f (Hz)", "drive (V)", "s", "outcome"], one.runs.map((r) => [
      h("a", { href: `#run/${id}/${encodeURIComponent(r.name)}` }, r.name), r.kind, r.role, num(r.frequency_hz, 6), num(r.amplitude_v, 4), num(r.samples / r.sample_rate_hz, 4), r.exit_status + (r.exit_reason ? `: ${r.exit_reason}` : "")]), { numeric: [3, 4, 5] }))) };
}
