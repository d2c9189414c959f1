// Rigs: how each stands; the simulated rigs' console.
import { api, attempt, get, post } from "../api.js";
import { card, h, num, table } from "../dom.js";

export default async function rigs() {
  const [list, options] = await Promise.all([get("/rigs"), get("/simulated-rigs/options")]);
  const again = () => { dispatchEvent(new HashChangeEvent("hashchange")); };
  const truth = h("div", { "aria-live": "polite" });
  const row = (rig) => [
    h("a", { href: `#live/${encodeURIComponent(rig.name)}` }, rig.name), rig.driver,
    h("span", { class: rig.state === "stopped" ? "bad" : "" }, rig.stopped_by ? `stopped by ${rig.stopped_by}` : rig.state), rig.holder || "free",
    h("span", { class: "row" },
      rig.state === "stopped" ? h("button", { type: "button", class: "primary", onclick: () => attempt(() => post(`/rigs/${rig.name}/reset`, {}, rig.name), "output is allowed again").then(again) }, "Reset stop") : "",
      h("button", { type: "button", "aria-label": `Calibration of ${rig.name}`, onclick: () => calibration(rig.name) }, "Calibration"),
      rig.driver === "simulated" ? h("button", { type: "button", onclick: () => reveal(rig.name) }, "Reveal") : "",
      rig.removable ? h("button", { type: "button", class: "danger", onclick: () => confirm(`Remove ${rig.name}? Its campaigns stay.`) && attempt(() => api("DELETE", `/simulated-rigs/${rig.name}`), "removed").then(again) }, "Remove") : "")];
  async function calibration(name) {
    const found = await attempt(() => get(`/rigs/${encodeURIComponent(name)}/calibrations`));
    if (!found) return;
    truth.replaceChildren(
      table(`What a campaign on ${name} would use now`, ["channel", "sensitivity", "skew", "calibrated by"], found.channels.map((c) => [
        c.channel, `${num(c.volts_per_unit, 5)} V/${c.unit}`, `${num(1e6 * c.skew_s, 3)} µs`, Object.entries(c.in_force).map(([method, id]) => `${method} (${id})`).join(", ") || "nominal value"])),
      found.remarks.length ? h("p", { class: "warn" }, found.remarks.join("; ")) : h("p", { class: "good" }, "Every channel's calibration is current."));
  }
  async function reveal(name) {
    if (!confirm(`Reveal what ${name} carries? The audit trail keeps that you asked.`)) return;
    const told = await attempt(() => post(`/simulated-rigs/${name}/reveal`));
    if (told) truth.replaceChildren(h("p", {}, told.effect ? `${name} carries ${told.effect} at ${told.location}: ${Object.entries(told.parameters).map(([k, v]) => `${k} = ${v.value} ${v.unit}`).join(", ")}` : `${name} carries nothing that the declared model lacks.`));
  }
  const effect = h("select", { name: "effect", onchange: parameters }, h("option", { value: "" }, "none"), h("option", { value: "sealed" }, "sealed: drawn from the seed, kept secret"), Object.keys(options.effects).map((key) => h("option", { value: key }, key)));
  const about = h("p", { class: "wide soft" }), fields = h("div", { class: "wide row" });
  function parameters() {
    const chosen = options.effects[effect.value];
    about.textContent = chosen ? `${chosen.about} (${chosen.location})` : "";
    fields.replaceChildren(...(chosen ? Object.entries(chosen.parameters).map(([name, meta]) => h("label", {}, `${name} (${meta.unit}, ${meta.barely} … ${meta.gross})`,
      h("input", { name: `p.${name}`, type: "number", step: "any", value: String(Math.sqrt(Math.abs(meta.barely * meta.gross)).toPrecision(3)) }))) : []));
  }
  const form = h("form", { class: "fields", onsubmit: add },
    h("label", {}, "Name", h("input", { name: "name", required: true, pattern: "[A-Za-z0-9][A-Za-z0-9 ._\\-]*", maxlength: "60" })),
    h("label", {}, "Preset", h("select", { name: "preset" }, options.presets.map((one) => h("option", {}, one)))),
    h("label", {}, "Seed", h("input", { name: "seed", type: "number", min: "0", value: "1" })),
    h("label", {}, "Noise, dB below the limit cycle", h("input", { name: "noise_db", type: "number", step: "any", min: "0", max: "140", placeholder: "0.2 Pa a microphone" })),
    h("label", {}, "Sample rate (Hz)", h("input", { name: "sample_rate_hz", type: "number", value: "10000", min: "1000" })),
    h("label", {}, "Clock", h("select", { name: "clock" }, h("option", { value: "virtual" }, "as fast as it can"), h("option", { value: "realtime" }, "real time"))),
    h("label", {}, "Effect that the declared model lacks", effect), about, fields,
    h("div", { class: "wide" }, h("button", { class: "primary" }, "Add simulated rig")));
  async function add(event) {
    event.preventDefault();
    const data = new FormData(form);
    const body = { name: data.get("name"), preset: data.get("preset"), seed: Number(data.get("seed")), sample_rate_hz: Number(data.get("sample_rate_hz")), clock: data.get("clock") };
    if (data.get("noise_db")) body.noise_db = Number(data.get("noise_db"));
    if (effect.value === "sealed") body.effects = "sealed";
    else if (effect.value) body.effects = { [effect.value]: Object.fromEntries([...data].filter(([k]) => k.startsWith("p.")).map(([k, v]) => [k.slice(2), Number(v)])) };
    const made = await attempt(() => post("/simulated-rigs", body), "rig added");
    if (made) again();
  }
  return { title: "Rigs", content: h("div", { class: "grid" },
    card("w7", "Rigs", table("", ["rig", "driver", "state", "control", "actions"], list.map(row)), truth),
    card("w5", "Simulated rig's console", form)) };
}
