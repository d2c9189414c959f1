// A closed loop: its rounds while they are made, and what they came to.
import { get } from "../api.js";
import { card, h, num, percent, table } from "../dom.js";
import { reportLinks } from "./identification.js";

const ENDINGS = {
  traced: ["good", "Traced: what the model lacked is found."],
  adequate: ["good", "Adequate: the declared model explains the data to within noise."],
  no_proposal: ["warn", "Open: the diagnosis proposes no further experiment."],
  out_of_budget: ["warn", "Open: rounds or rig time are used up."],
  stopped: ["bad", "Stopped."],
};

// what its rounds have said so far
export async function roundsSoFar(id) {
  const lines = (await get(`/jobs/${id}/log`)).filter((line) => line.includes(" round "));
  return h("div", { role: "log", "aria-label": "Rounds so far" }, lines.length ? lines.map((line) => h("p", {}, line.slice(line.indexOf("round ")))) : h("p", { class: "soft" }, "The first round is under way."));
}

export async function drawLoop(job) {
  const closed = await get(`/jobs/${job.id}/result`);
  const [tone, words] = ENDINGS[closed.ending];
  const last = closed.rounds.at(-1);
  return h("div", { class: "grid" },
    card("", "Verdict", h("p", { class: `verdict ${tone}`, id: "verdict", "data-verdict": last?.verdict ?? closed.ending }, words),
      last?.effects.length ? h("h3", {}, last.effects.join(" + ")) : "", h("p", {}, closed.reason),
      h("p", { class: "soft" }, `${closed.rounds.length} ${closed.rounds.length === 1 ? "round" : "rounds"}, ${num(closed.rig_seconds / 60, 3)} minutes of rig time`),
      last ? reportLinks({ "HTML report": `/close-loops/${job.id}/report`, JSON: `/jobs/${job.id}/result` }) : ""),
    card("", "Rounds", table("Error before and after, by round", ["#", "campaign", "runs", "verdict", "effects", "rivals", "χ²/dof", "validation error"], closed.rounds.map((one) => [
      one.number, h("a", { href: `#campaign/${one.campaign}` }, one.campaign), one.runs, one.verdict, one.effects.join(", "), one.rivals.join(", "),
      `${num(one.before.chi2_per_dof, 4)} → ${num(one.after.chi2_per_dof, 4)}`, `${percent(one.before.validation_error)} → ${percent(one.after.validation_error)}`]), { numeric: [0, 2, 6, 7] })));
}
