// Jobs: what waits, runs and is done; cancel and open.
import { api, attempt, get } from "../api.js";
import { card, h, table } from "../dom.js";
import * as model from "../model.js";

export default async function jobs() {
  const list = h("div", {});
  async function draw() {
    const { items } = await get("/jobs", { limit: 100 });
    list.replaceChildren(table("", ["created", "kind", "title", "by", "state", "progress", "actions"], items.map((job) => [
      job.created.slice(0, 19).replace("T", " "), job.kind, job.title, job.owner, h("span", { class: job.state === "failed" ? "bad" : "" }, (job.hold || job.state) + (job.error && job.state === "failed" ? `: ${job.error}` : "")),
      h("progress", { max: "1", value: String(job.progress), "aria-label": `progress of ${job.title}` }), actions(job)])));
  }
  function actions(job) {
    const links = [];
    if (["identification", "diagnosis", "close_loop"].includes(job.kind)) links.push(h("a", { href: `#result/${job.id}` }, "open"));
    if (["campaign", "close_loop", "watch"].includes(job.kind)) links.push(h("a", { href: `#live/${encodeURIComponent(job.about.rig)}` }, "live"));
    if (job.about.campaign) links.push(h("a", { href: `#campaign/${job.about.campaign}` }, "campaign"));
    if (["queued", "running"].includes(job.state) && job.lane === "analysis") links.push(h("button", { type: "button", onclick: () => attempt(() => api("DELETE", `/jobs/${job.id}`)).then(draw) }, "Cancel"));
    return h("span", { class: "row" }, links);
  }
  let last = 0;
  const stop = model.watch(() => { if (Date.now() - last > 800) { last = Date.now(); draw().catch(() => {}); } });
  await draw();
  return { title: "Jobs", content: h("div", { class: "grid" }, card("", "Jobs, newest first", list)), close: stop };
}
