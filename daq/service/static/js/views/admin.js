// Administration, for keys of scope admin: API keys, and who did what.
import { api, attempt, get, post } from "../api.js";
import { card, h, table } from "../dom.js";

const SCOPES = { read: "see everything, press stop", control: "move rigs, start work", configure: "change what others rely on", admin: "everything" };
const when = (text) => (text ? text.slice(0, 19).replace("T", " ") : "never");

export default async function admin() {
  const list = h("div", {}), told = h("div", { "aria-live": "polite" }), trail = h("div", {});

  async function drawKeys() {
    const keys = await get("/keys");
    list.replaceChildren(table("", ["id", "name", "scopes", "created", "expires", "state", "action"], keys.map((key) => [
      h("code", {}, key.id), key.name, key.scopes.join(", "), when(key.created), when(key.expires),
      h("span", { class: key.state === "active" ? "good" : "soft" }, key.state),
      key.state === "active" ? h("button", { type: "button", class: "danger", "aria-label": `Revoke ${key.name} ${key.id}`, onclick: () => revoke(key) }, "Revoke") : ""]),
    { empty: "no key yet: make one before the service listens elsewhere" }));
  }
  async function revoke(key) {
    if (!confirm(`Revoke the key ${key.id} of ${key.name}? Whoever uses it is shut out at once.`)) return;
    await attempt(() => api("DELETE", `/keys/${key.id}`), "revoked");
    await draw();
  }

  const form = h("form", { class: "fields", onsubmit: create },
    h("label", {}, "Name, for the audit trail", h("input", { name: "name", required: true, maxlength: "100" })),
    h("label", {}, "Expires in days (empty: never)", h("input", { name: "days", type: "number", min: "0.01", step: "any", value: "365" })),
    h("fieldset", { class: "wide row" }, h("legend", {}, "Scopes"),
      Object.entries(SCOPES).map(([name, about]) => h("label", { class: "check" }, h("input", { type: "checkbox", name: "scope", value: name, checked: name === "read" }), `${name}: ${about}`))),
    h("div", { class: "wide" }, h("button", { class: "primary" }, "Make a key")));
  async function create(event) {
    event.preventDefault();
    const data = new FormData(form), days = data.get("days");
    const made = await attempt(() => post("/keys", { name: data.get("name"), scopes: data.getAll("scope"), expires_days: days ? Number(days) : null }));
    if (!made) return;
    told.replaceChildren(h("p", {}, `The key of ${made.name}; it is shown this once:`),
      h("p", { class: "row" }, h("code", { id: "newkey" }, made.key),
        h("button", { type: "button", onclick: () => attempt(() => navigator.clipboard.writeText(made.key), "copied") }, "Copy"),
        h("button", { type: "button", onclick: () => told.replaceChildren() }, "Hide")));
    await draw();
  }

  let lines = [];
  const search = h("input", { type: "search", "aria-label": "Search the audit trail", placeholder: "who, what, which", oninput: showTrail });
  const rest = ({ time, who, action, target, ...more }) => Object.entries(more).map(([k, v]) => `${k} ${typeof v === "object" ? JSON.stringify(v) : v}`).join(", ");
  function showTrail() {
    const words = search.value.toLowerCase().split(/\s+/).filter(Boolean);
    const found = lines.filter((line) => { const text = Object.values(line).join(" ").toLowerCase(); return words.every((word) => text.includes(word)); });
    trail.replaceChildren(table(`${found.length} of the last ${lines.length} actions, newest first`, ["time (UTC)", "who", "action", "on", "with"],
      found.map((line) => [when(line.time), line.who, line.action, line.target, rest(line)])));
  }
  async function draw() {
    await drawKeys();
    lines = await get("/audit", { limit: 1000 });
    showTrail();
  }
  await draw();
  return { title: "Administration", content: h("div", { class: "grid" },
    card("w7", "API keys", list),
    card("w5", "New key", form, told),
    card("", "Audit trail: who moved the speaker, or changed anything", h("div", { class: "row" }, search, h("button", { type: "button", onclick: () => attempt(draw) }, "Refresh")), trail)) };
}
