// Diagnosis: verdict, error before and after, residual by harmonic and condition, candidates, next experiment.
import { attempt, get, post } from "../api.js";
import { card, chance, h, num, percent, table, unit, withError } from "../dom.js";
import { curveCards, parameterTable, reportLinks } from "./identification.js";

const WORDS = {
  no_discrepancy: ["good", "No discrepancy: the declared model explains the data to within noise."],
  traced: ["good", "Traced: what the model lacked is found."],
  ambiguous: ["warn", "Ambiguous: several causes explain the data alike."],
  unexplained: ["bad", "Unexplained: nothing known explains the rest."],
};

// one cell for a harmonic of a run: how many standard errors measured and modelled differ
function heat(caption, rows) {
  const harmonics = Math.max(0, ...rows.map((row) => row.in_stderr.length));
  const shade = (v) => {
    if (v === null || v === undefined) return "";
    const share = Math.min(1, Math.log10(1 + Math.max(0, v - 1)) / 2.2);
    return `background: color-mix(in srgb, var(--bad) ${(70 * share).toFixed(0)}%, transparent)`;
  };
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption }, h("table", { class: "heat" }, h("caption", {}, caption),
    h("thead", {}, h("tr", {}, h("th", { scope: "col" }, "run"), h("th", { scope: "col" }, "role"), Array.from({ length: harmonics }, (_, k) => h("th", { scope: "col", "aria-label": `harmonic ${k + 1}` }, String(k + 1))))),
    h("tbody", {}, rows.map((row) => h("tr", {}, h("th", { scope: "row" }, row.run), h("td", {}, row.role), Array.from({ length: harmonics }, (_, k) => h("td", { style: shade(row.in_stderr[k]) }, num(row.in_stderr[k], 2))))))));
}

export async function drawDiagnosis(job) {
  const [d, detail] = await Promise.all([get(`/diagnoses/${job.id}`), get(`/diagnoses/${job.id}/details`)]);
  const [tone, words] = WORDS[d.verdict];
  // Where nothing was added to the model there is one state of it, not a before and an after.
  const states = JSON.stringify(d.before) === JSON.stringify(d.after) ? { "": d.before } : { before: d.before, after: d.after };
  const titled = (text, when) => `${text} ${when}`.trim(), width = (narrow) => (Object.keys(states).length > 1 ? narrow : "");
  const line = (name, told) => [name, ...Object.values(states).map(told)];
  const next = d.next_experiment;
  const run = async () => {
    const rigs = await attempt(() => get("/rigs"));
    if (!rigs) return;
    const rig = job.about.rig || rigs[0]?.name;
    const made = await attempt(() => post(`/diagnoses/${job.id}/next-experiment`, { rig }, rig), "next experiment queued");
    if (made) location.hash = `live/${made.about.rig}`;
  };
  return h("div", { class: "grid" },
    card("w5", "Verdict", h("p", { class: `verdict ${tone}`, id: "verdict", "data-verdict": d.verdict }, words),
      d.effects.map((e) => h("div", {}, h("h3", {}, `${e.effect} (${e.location})`), h("dl", {}, Object.entries(e.parameters).flatMap(([name, p]) => [h("dt", {}, name), h("dd", {}, `${withError(p.value, p.stderr)} ${unit(p.unit)}`)])))),
      d.explanation ? h("p", {}, d.explanation) : "", reportLinks({ "HTML report": `/diagnoses/${job.id}/report`, JSON: `/diagnoses/${job.id}` })),
    card("w7", states.before ? "Error before and after" : "Error", table("", ["", ...Object.keys(states)], [
      line("validation error", (s) => percent(s.validation_error)), line("fit error", (s) => percent(s.fit_error)), line("χ² per degree of freedom", (s) => num(s.chi2_per_dof, 4)),
      line("noise floor", () => percent(d.noise_floor)), line("noise and parameters' uncertainty", (s) => percent(s.expected_error))], { numeric: [1, 2] }),
      h("p", { class: "soft" }, `${titled("Residual", states.before ? "before" : "")}: ${d.residual.significant ? "significant" : "within noise"}, p ${chance(d.residual.p_value).replace(/^(?!<)/, "= ")}. ${num(d.seconds, 3)} s.`)),
    Object.keys(states).map((when) => card(width("w6"), titled("Residual", when), heat("Measured less modelled by harmonic, in standard errors", detail[when || "before"]))),
    card("", "Candidates, best first", table("", ["effects", "where", "χ²/dof", "validation error", "p of the gain", "parameters", "remarks"], d.candidates.map((c) => [
      c.effects.join(" + "), c.locations.join(", "), num(c.chi2_per_dof, 4), percent(c.validation_error), chance(c.p_value), Object.entries(c.parameters).map(([k, p]) => `${k} = ${withError(p.value, p.stderr)} ${unit(p.unit)}`.trim()).join("; "),
      [c.plausible ? "" : "implausible", c.equivalent_to.length ? `not told apart from ${c.equivalent_to.join(", ")}` : "", c.note || ""].filter(Boolean).join("; ")]), { numeric: [2, 3, 4], empty: "none was needed" })),
    d.whereabouts ? card("", d.whereabouts.from_run_to_run ? "Where it may lie: it differs from run to run" : "Where it may lie", table("χ²/dof with a free shape or one known effect in that place of the loop", ["place", "χ²/dof", "verdict"], [["nowhere: as declared", num(d.whereabouts.before, 4), ""],
      ...Object.entries(d.whereabouts.chi2_per_dof).map(([place, left]) => [place, num(left, 4), d.whereabouts.likely.includes(place) ? "may lie here" : "ruled out, or too little taken up"])], { numeric: [1] })) : "",
    card("", "Next experiment", next ? [h("p", {}, next.reason || next.why || "What to measure to tell the rivals apart:"), h("pre", { class: "scroll", tabindex: "0" }, JSON.stringify(next, null, 1)), h("button", { type: "button", class: "primary", onclick: run }, "Run it")] : h("p", {}, ["traced", "no_discrepancy"].includes(d.verdict) ? "None is needed." : "None is proposed.")),
    Object.entries(states).map(([when, state]) => card(width("w6"), titled("Parameters", when), parameterTable("", state.parameters))),
    curveCards(detail.curves),
    d.quality.length ? card("", "Data quality", table("", ["run", "flag", "detail", "severity"], d.quality.map((q) => [q.run, q.flag, q.detail, q.severity]))) : "");
}
