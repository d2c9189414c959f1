// A result: identification or diagnosis, while it is made and when it is done.
import { api, attempt, get, post } from "../api.js";
import { card, h } from "../dom.js";
import * as model from "../model.js";
import { drawDiagnosis } from "./diagnosis.js";
import { drawIdentification } from "./identification.js";
import { drawLoop, roundsSoFar } from "./loop.js";

const KINDS = {
  identification: { title: "Identification", draw: drawIdentification },
  diagnosis: { title: "Diagnosis", draw: drawDiagnosis },
  close_loop: { title: "Closed loop", draw: drawLoop, rounds: roundsSoFar },
};

export default async function result([id]) {
  let job = await get(`/jobs/${id}`);
  const kind = KINDS[job.kind] ?? KINDS.identification, rig = job.about.rig;
  const box = h("div", {}), rounds = h("div", {});
  const bar = h("progress", { max: "1", "aria-label": "Progress" }), message = h("p", { role: "status" });
  let shown = false, said = null;
  async function draw() {
    job = model.job(id) || job;
    bar.value = job.progress;
    message.textContent = job.state === "running" ? job.message || "starting" : job.state;
    if (shown) return;
    if (["queued", "running"].includes(job.state)) {
      if (kind.rounds && job.message !== said) { said = job.message; rounds.replaceChildren(await kind.rounds(id)); }
      return;
    }
    shown = true;
    if (job.state !== "succeeded") {
      box.replaceChildren(card("", "No result", h("p", { class: "bad", role: "alert" }, job.error || job.state)));
      return;
    }
    await attempt(async () => box.replaceChildren(await kind.draw(job)));
  }
  const end = rig && job.lane !== "analysis" ? () => post(`/jobs/${id}/stop`, {}, rig) : () => api("DELETE", `/jobs/${id}`);
  const waiting = card("", job.title, bar, message, rounds, h("div", { class: "row" }, h("button", { type: "button", class: "danger", onclick: () => attempt(end, "cancelled") }, "Cancel"),
    kind.rounds ? h("a", { href: `#live/${encodeURIComponent(rig)}` }, "watch it live") : ""));
  box.append(waiting);
  const stop = model.watch(draw);
  draw();
  return { title: kind.title, content: [h("p", {}, h("a", { href: `#campaign/${job.about.campaign}` }, `campaign ${job.about.campaign}`)), box], close: stop };
}
