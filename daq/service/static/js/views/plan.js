// New campaign: a form, a dry run, a start.
import { attempt, get, post } from "../api.js";
import { card, h, num, table } from "../dom.js";

const numbers = (text) => text.split(/[\s,;]+/).filter(Boolean).map(Number);

export default async function plan() {
  const rigs = await get("/rigs");
  const field = (label, name, attributes = {}) => h("label", {}, label, h("input", { name, ...attributes }));
  const form = h("form", { class: "fields", onsubmit: start },
    h("label", {}, "Rig", h("select", { name: "rig" }, rigs.map((rig) => h("option", { value: rig.name }, rig.name)))),
    field("Title", "title", { value: "around the limit cycle", required: true, maxlength: "100" }),
    field("Frequencies, % from the limit cycle", "offsets", { value: "-5.5 -4 -2.6 -1.4 0.8 1.8 3 4.3 5.6", required: true }),
    field("Amplitudes, × threshold (taken in turn)", "factors", { value: "1.3 2 3", required: true }),
    field("Validation frequencies, %", "validation", { value: "-3.3 2.4 3.6" }),
    field("Validation amplitudes, × threshold", "vfactors", { value: "2.5 1.6 2.5" }),
    field("Recording (s)", "record_s", { value: "2", type: "number", step: "any", min: "0.1" }),
    field("Criterion (dB below the free level)", "criterion_db", { value: "20", type: "number", step: "any", min: "3", max: "80" }),
    h("label", {}, "Strategy", h("select", { name: "strategy" }, h("option", { value: "predict" }, "predict, then verify"), h("option", { value: "step" }, "step up (the thesis)"))),
    field("Narrower output limit (V), optional", "limit_v", { type: "number", step: "any", min: "0" }),
    h("label", { class: "check" }, h("input", { type: "checkbox", name: "cold" }), "also cold runs (flame off)"),
    h("label", { class: "wide" }, "Or a plan as JSON (campaign-plan/1); overrides the fields above", h("textarea", { name: "json", rows: "3", spellcheck: "false" })),
    h("div", { class: "wide row" },
      h("button", { type: "button", id: "dryrun", onclick: rehearse }, "Dry run"),
      h("button", { type: "button", id: "closeloop", onclick: closeLoop }, "Close the loop"),
      h("button", { class: "primary", id: "startcampaign" }, "Start campaign")));
  const report = h("div", { "aria-live": "polite" }, h("p", { class: "soft" }, "A dry run shows every condition, the limits and the rig time, and moves nothing."));

  function body() {
    const data = new FormData(form);
    const text = data.get("json").trim();
    if (text) return { rig: data.get("rig"), plan: JSON.parse(text) };
    const fit = numbers(data.get("offsets")), factors = numbers(data.get("factors"));
    const check = numbers(data.get("validation")), vfactors = numbers(data.get("vfactors"));
    if (!fit.length || !factors.length || [...fit, ...factors, ...check, ...vfactors].some(Number.isNaN)) throw new Error("frequencies and amplitudes are lists of numbers, such as: -4 -2 1.5");
    const conditions = fit.map((p, i) => ({ offset: p / 100, over_threshold: factors[i % factors.length] }));
    check.forEach((p, i) => conditions.push({ offset: p / 100, over_threshold: (vfactors.length ? vfactors : factors)[i % (vfactors.length || factors.length)], role: "validation" }));
    const made = { title: data.get("title"), record_s: Number(data.get("record_s")), criterion_db: Number(data.get("criterion_db")), strategy: data.get("strategy"), conditions };
    if (data.get("limit_v")) made.limit_v = Number(data.get("limit_v"));
    if (data.get("cold")) made.cold = [-0.05, 0, 0.05].map((offset) => ({ offset, amplitude_v: Math.min(1, made.limit_v ?? 1) }));
    return { rig: data.get("rig"), plan: made };
  }
  async function rehearse() {
    const done = await attempt(() => post("/campaigns/dry-run", body()));
    if (!done) return;
    report.replaceChildren(
      h("p", {}, `${done.runs} runs, about ${num(done.rig_seconds / 60, 3)} minutes of rig time, at most ${num(done.limit_v, 3)} V.`),
      done.problems.length ? h("p", { class: "bad", role: "alert" }, done.problems.join("; ")) : h("p", { class: "good" }, "Nothing stands against it."),
      table("Conditions", ["#", "kind", "role", "frequency", "amplitude", "s", "problem"], done.conditions.map((c) => [
        c.index, c.kind, c.role,
        c.frequency_hz ? `${num(c.frequency_hz, 6)} Hz` : c.offset !== null ? `${num(100 * c.offset, 3)} % from the limit cycle` : "free",
        c.amplitude_v ? `${num(c.amplitude_v, 3)} V` : c.over_threshold ? `${num(c.over_threshold, 3)} × threshold` : "–", num(c.seconds, 3), c.problem || ""]), { numeric: [0, 5] }));
  }
  async function closeLoop() {
    const made = await attempt(() => { const b = body(); return post("/close-loops", b, b.rig); }, "queued: campaign, diagnosis, next experiment, until a verdict stands");
    if (made) location.hash = `result/${made.id}`;
  }
  async function start(event) {
    event.preventDefault();
    const made = await attempt(() => { const b = body(); return post("/campaigns", b, b.rig); }, "campaign queued");
    if (made) location.hash = `live/${made.about.rig}`;
  }
  return { title: "New campaign", content: h("div", { class: "grid" }, card("w6", "Plan", form), card("w6", "Dry run", report)) };
}
