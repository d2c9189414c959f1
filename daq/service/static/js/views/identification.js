// Identification: parameters with uncertainty, errors, the free limit cycle, Nyquist, nonlinearity.
import { attempt, get, key, post } from "../api.js";
import { card, h, num, percent, table, unit, withError } from "../dom.js";
import { scatter } from "../plot.js";

export function parameterTable(caption, parameters) {
  return table(caption, ["parameter", "value ± standard error", "unit"], Object.entries(parameters).map(([name, p]) => [name, withError(p.value, p.stderr), unit(p.unit)]), { empty: "the fit did not converge: no parameters are claimed" });
}

export function cycleTable(cycle) {
  const row = (name, one) => [name, one ? `${num(one.frequency_hz, 6)} Hz` : "–", one ? num(one.amplitude, 5) : "–", one ? one.harmonics.map((v) => num(v, 3)).join("  ") : "–"];
  return table("Free limit cycle", ["", "frequency", "amplitude (m/s)", "harmonics over the fundamental"], [row("measured", cycle.measured), row("model's own", cycle.model)]);
}

export function bands(x, band) {
  return [...x.map((v, i) => [v, band.high[i]]), ...x.map((v, i) => [v, band.low[i]]).reverse()];
}

const micrometres = (point) => point.map((v) => 1e6 * v);

export function curveCards(curves) {
  if (!curves) return [];
  const at = curves.frequency_hz.findIndex((f) => f >= curves.free_hz);
  const loop = curves.loop.re.map((re, i) => [re, curves.loop.im[i]]);
  return [
    card("w4", "Nyquist curve of the loop", scatter({ label: "Loop gain in the complex plane; the critical point is +1", width: 400, x: "Re L(jω)", y: "Im L(jω)", equal: true, height: 320, lines: [{ points: loop, colour: "--c1", label: "L(jω)" }],
      points: [{ x: 1, y: 0, colour: "--bad", cross: true, label: "critical point +1 (positive feedback)" }, { x: loop[at][0], y: loop[at][1], colour: "--c3", label: `limit cycle, ${num(curves.free_hz, 6)} Hz` }] }),
      h("p", { class: "soft" }, "Cross: critical point +1. Dot: at the limit cycle's frequency.")),
    card("w4", "Loop gain", scatter({ label: "Loop gain against frequency with 95 % band", width: 400, x: "frequency (Hz)", y: "dB", points: [], height: 320, lines: [{ points: curves.frequency_hz.map((f, i) => [f, curves.gain_db.value[i]]), colour: "--c1" }], bands: [{ points: bands(curves.frequency_hz, curves.gain_db), colour: "--c1" }] })),
    card("w4", "Nonlinearity", scatter({ label: "Flame output against flame input with 95 % band", width: 400, x: "flame input w (µm)", y: "flame output N(w) (µm)", points: [], height: 320,
      lines: [{ points: curves.flame_input.map((w, i) => [w, curves.flame_output.value[i]]).map(micrometres), colour: "--c2", label: "N(w)" }, { points: curves.flame_input.map((w) => [w, w]).map(micrometres), colour: "--soft", dash: true, label: "linear" }], bands: [{ points: bands(curves.flame_input, curves.flame_output).map(micrometres), colour: "--c2" }] }),
      h("p", { class: "soft" }, "Over the range that the free limit cycle reaches; dashed: linear.")),
  ];
}

// links: what is shown to the path under the API
export function reportLinks(links) {
  // A new tab cannot send the key: it gets a one-time pass instead.
  const open = async (event) => {
    if (!key()) return;
    event.preventDefault();
    const href = event.target.href, tab = window.open("about:blank");
    tab.opener = null;
    const pass = await attempt(() => post("/live/ticket"));
    if (pass) tab.location = `${href}?ticket=${encodeURIComponent(pass.ticket)}`;
    else tab.close();
  };
  return h("p", { class: "row" }, Object.entries(links).map(([text, path]) => h("a", { href: `/api/v1${path}`, target: "_blank", rel: "noopener", onclick: open }, text)));
}

export async function drawIdentification(job) {
  const [found, detail] = await Promise.all([get(`/identifications/${job.id}`), get(`/identifications/${job.id}/details`)]);
  // χ²/dof has mean 1 and variance 2/dof where only noise is left
  const lacks = found.converged && found.chi2_per_dof > 1 + 4 * Math.sqrt(2 / found.dof);
  return h("div", { class: "grid" },
    card("w5", "Fit", h("p", { class: found.converged ? "verdict good" : "verdict bad" }, found.converged ? "converged" : `not converged: ${found.reason}`),
      lacks ? h("p", { class: "warn" }, "The declared model does not explain these data to within noise: Diagnose says what it lacks.") : "",
      table("", ["", ""], [["fit error", percent(found.fit_error)], ["validation error", percent(found.validation_error)], ["noise floor", percent(found.noise_floor)], ["χ² per degree of freedom", `${num(found.chi2_per_dof, 4)} (${found.dof})`], ["seconds", num(found.seconds, 3)]]),
      cycleTable(found.free_limit_cycle), reportLinks({ "HTML report": `/identifications/${job.id}/report`, JSON: `/identifications/${job.id}` })),
    card("w7", "Parameters", parameterTable("", found.parameters), found.undetermined?.length ? h("p", { class: "warn" }, `Not determined by these data: ${found.undetermined.join("; ")}`) : ""),
    curveCards(detail.curves),
    found.quality.length ? card("", "Data quality", table("", ["run", "flag", "detail", "severity"], found.quality.map((q) => [q.run, q.flag, q.detail, q.severity]))) : "");
}
