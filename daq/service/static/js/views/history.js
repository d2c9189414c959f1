// History: campaigns with search, and recordings from elsewhere brought in.
import { api, attempt, get } from "../api.js";
import { card, h, table } from "../dom.js";

export default async function history() {
  const items = [];
  let after = null;
  do {
    const page = await get("/campaigns", { limit: 200, after });
    items.push(...page.items);
    after = page.next;
  } while (after && items.length < 5000);
  items.sort((a, b) => b.created_at.localeCompare(a.created_at));
  const search = h("input", { type: "search", placeholder: "title, id, rig, verdict", "aria-label": "Search campaigns", size: "34", oninput: draw });
  const list = h("div", {}), count = h("span", { class: "soft", role: "status" });
  const file = h("input", { type: "file", accept: ".zip", "aria-label": "Zipped campaign folder" });
  const upload = h("button", { type: "button", onclick: async () => {
    const chosen = file.files[0];
    if (!chosen) return;
    const job = await attempt(() => api("POST", "/imports", { body: chosen, query: { name: chosen.name } }), "upload received; importing");
    if (job) location.hash = "jobs";
  } }, "Import");

  function draw() {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = items.filter((c) => words.every((w) => `${c.id} ${c.title} ${c.rig} ${c.verdict || ""} ${c.status} ${c.created_at}`.toLowerCase().includes(w)));
    count.textContent = `${found.length} of ${items.length}`;
    list.replaceChildren(table("", ["campaign", "title", "rig", "created", "status", "verdict"], found.slice(0, 500).map((c) => [
      h("a", { href: `#campaign/${c.id}` }, c.id), c.title, c.rig || "imported", c.created_at.slice(0, 19).replace("T", " "), c.status, c.verdict || "not diagnosed"])));
  }
  draw();
  return { title: "History", content: h("div", { class: "grid" },
    card("w8", "Campaigns", h("div", { class: "row" }, search, count), list),
    card("w4", "Bring recordings in", h("p", { class: "soft" }, "A campaign folder (campaign.toml and recordings) as a zip file. Other formats: ", h("code", {}, "entrain import"), "."), h("div", { class: "row" }, file, upload))) };
}
