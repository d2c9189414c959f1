// One run: waveform that can be zoomed down to samples, spectrum of what is in view, downloads.
import { attempt, download, get } from "../api.js";
import { card, h, num } from "../dom.js";
import { Curves } from "../plot.js";

export default async function run([campaign, name]) {
  const base = `/campaigns/${campaign}/runs/${encodeURIComponent(name)}`;
  const facts = await get(base);
  const channels = facts.channels.map((c) => c.name);
  const picker = h("select", { "aria-label": "Channel", onchange: () => draw() }, channels.map((c) => h("option", {}, c)));
  const inView = h("span", { class: "soft", role: "status" });
  const wave = new Curves({ label: "Waveform, drag to zoom", x: "time (s)", y: "", height: 260, series: [{ label: "smallest", colour: "--c1" }, { label: "largest", colour: "--c1" }], bands: [{ series: [2, 1] }], onZoom: (a, b) => zoom(a, b) });
  let from = 0, to = facts.samples;
  const rate = facts.sample_rate_hz;
  const spectrum = new Curves({ label: "Amplitude spectrum of what is in view", x: "frequency (Hz)", y: "", height: 260, series: [{ label: "amplitude", colour: "--c2" }],
    marks: () => facts.frequency_hz ? [{ x: facts.frequency_hz, label: "forcing", colour: "--c4" }] : [] });

  function zoom(a, b) { from = Math.max(0, Math.round(a * rate)); to = Math.min(facts.samples, Math.max(from + 8, Math.round(b * rate))); draw(); }
  function move(share) { const width = to - from, by = Math.round(share * width); from = Math.min(facts.samples - width, Math.max(0, from + by)); to = from + width; draw(); }
  function scale(factor) { const middle = (from + to) / 2, half = (to - from) * factor / 2; zoom((middle - half) / rate, (middle + half) / rate); }
  async function draw() {
    const channel = picker.value;
    await attempt(async () => {
      const [band, lines] = await Promise.all([
        get(`${base}/envelope`, { start: from, stop: to, points: 1200 }),
        get(`${base}/spectrum`, { start: from, stop: to, channel, max_hz: Math.min(rate / 2, 1500), points: 3000 })]);
      wave.measure(band.units[channel]);
      spectrum.measure(`dB re 1 ${band.units[channel]}`);
      wave.set([band.time_s, band.channels[channel].min, band.channels[channel].max]);
      spectrum.set([lines.frequency_hz, lines.channels[channel].map((v) => 20 * Math.log10(Math.max(v, 1e-12)))]);
      inView.textContent = `${num(from / rate, 6)} s to ${num(to / rate, 6)} s, in ${band.units[channel]}; ${band.frames_per_bin === 1 ? "every sample" : `${band.frames_per_bin} samples a point`}; spectrum lines ${num(lines.resolution_hz, 3)} Hz apart`;
    });
  }
  const button = (text, act, label) => h("button", { type: "button", onclick: act, "aria-label": label || text }, text);
  const notes = Object.entries(facts.notes).flatMap(([name, value]) => value && typeof value === "object" && !Array.isArray(value) ? Object.entries(value).map(([inner, v]) => [`${name}: ${inner}`, v]) : [[name, value]]).filter(([, value]) => value !== "");
  const said = (value) => Array.isArray(value) ? value.map(said).join("; ") : num(value, 4);
  const rows = [["kind", facts.kind], ["role", facts.role], ["forcing", facts.frequency_hz ? `${num(facts.frequency_hz, 6)} Hz at ${num(facts.amplitude_v)} V` : "none"],
    ["recorded", facts.started_at], ["length", `${num(facts.samples / rate, 5)} s at ${num(rate, 6)} Hz`], ["outcome", facts.exit_status + (facts.exit_reason ? `: ${facts.exit_reason}` : "")],
    ["lost frames", String(facts.gaps.reduce((sum, gap) => sum + gap.frames, 0))], ["SHA-256", facts.sha256 || "–"]];
  draw();
  return { title: `Run ${name}`, content: h("div", { class: "grid" },
    card("", "Waveform", h("div", { class: "row" }, picker, button("−", () => scale(4), "Zoom out"), button("+", () => scale(0.25), "Zoom in"), button("◀", () => move(-0.5), "Earlier"), button("▶", () => move(0.5), "Later"), button("All", () => zoom(0, facts.samples / rate)), inView), wave.root),
    card("w8", "Spectrum of what is in view", spectrum.root),
    card("w4", "Run", h("dl", {}, rows.flatMap(([k, v]) => [h("dt", {}, k), h("dd", {}, v)])), h("p", {}),
      notes.length ? h("details", {}, h("summary", {}, "Notes of the campaign"), h("dl", {}, notes.flatMap(([k, v]) => [h("dt", {}, k.replaceAll("_", " ")), h("dd", {}, said(v))]))) : "", h("p", {}),
      h("div", { class: "row" }, ["hdf5", "csv", "npz", "mat"].map((form) => button(form.toUpperCase(), () => attempt(() => download(`${base}/download?format=${form}`, `${name}.${form === "hdf5" ? "h5" : form}`)), `Download as ${form}`))),
      h("p", {}, h("a", { href: `#campaign/${campaign}` }, "back to the campaign")))) };
}
