// Plots in the page's colours: uPlot for curves, SVG for points, a canvas for the phase portrait.
import uPlot from "../vendor/uplot/uPlot.esm.js";
import { css, h, num, s } from "./dom.js";

const drawn = new Set();

// redraw everything when the theme changes
export function recolour() { for (const plot of drawn) if (plot.root.isConnected) plot.rebuild(); else drawn.delete(plot); }

export class Curves {
  // series: [{label, colour}], marks: () => [{x, label, colour}]
  constructor({ label, x, y, series, height = 230, marks = () => [], onZoom = null, range = null, bands = null }) {
    this.root = h("div", { role: "img", "aria-label": label, class: "plot" });
    this.options = { label, x, y, series, height, marks, onZoom, range, bands };
    this.data = [[], ...series.map(() => [])];
    this.observer = new ResizeObserver(() => this.resize());
    this.observer.observe(this.root);
    drawn.add(this);
  }
  rebuild() {
    const { x, y, series, height, marks, onZoom, range } = this.options;
    if (this.plot) this.plot.destroy();
    const axis = { stroke: css("--soft"), grid: { stroke: css("--grid"), width: 1 }, ticks: { stroke: css("--grid"), width: 1 }, font: "11px system-ui", labelFont: "12px system-ui" };
    this.plot = new uPlot({
      width: this.root.clientWidth || 300, height,
      scales: { x: { time: false }, y: range ? { range } : {} },
      axes: [{ ...axis, label: x, labelSize: 18, size: 32, values: (_, v, _i, _s, step) => v.map((t) => num(t, digits(v, step))) }, { ...axis, label: y, labelSize: 16, size: 52, values: (_, v) => v.map((t) => num(t, 3)) }],
      legend: { show: series.length > 1 && !this.options.bands, live: false },
      cursor: { drag: { x: true, y: false }, points: { show: false } },
      series: [{}, ...series.map((one) => ({ label: one.label, stroke: css(one.colour), width: one.width ?? 1.4, points: { show: false }, dash: one.dash, band: one.band, spanGaps: true }))],
      bands: this.options.bands ? this.options.bands.map((b) => ({ ...b, fill: css("--wash") })) : undefined,
      hooks: {
        draw: [(u) => drawMarks(u, marks())],
        setSelect: onZoom ? [(u) => {
          if (u.select.width > 4) onZoom(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
        }] : [],
      },
    }, this.data, this.root);
  }
  resize() { if (this.root.clientWidth && (!this.plot || Math.abs(this.plot.width - this.root.clientWidth) > 2)) this.rebuild(); }
  // name what the ordinate counts in
  measure(y) {
    if (y === this.options.y) return;
    this.options.y = y;
    if (this.plot) this.rebuild();
  }
  set(data) {
    this.data = data;
    if (this.plot) this.plot.setData(data);
  }
}

// as many digits as tell neighbours apart, however deep the zoom
const digits = (values, step) => Math.max(3, Math.ceil(Math.log10(Math.max(...values.map(Math.abs), step) / step)) + 2);

function drawMarks(u, marks) {
  const { ctx } = u;
  ctx.save();
  ctx.textBaseline = "alphabetic";
  ctx.font = `${11 * devicePixelRatio}px system-ui`;
  const shown = marks.filter((mark) => mark.x !== null && mark.x !== undefined).sort((a, b) => a.x - b.x);
  for (const mark of shown) {
    const at = u.valToPos(mark.x, "x", true);
    if (at < u.bbox.left || at > u.bbox.left + u.bbox.width) continue;
    ctx.strokeStyle = ctx.fillStyle = css(mark.colour);
    ctx.setLineDash([4 * devicePixelRatio, 3 * devicePixelRatio]);
    ctx.beginPath(); ctx.moveTo(at, u.bbox.top); ctx.lineTo(at, u.bbox.top + u.bbox.height); ctx.stroke();
    // the leftmost of several is named on its left, so that no line runs through a name
    const left = shown.length > 1 && mark === shown[0] && at - u.bbox.left > 90 * devicePixelRatio;
    ctx.textAlign = left ? "right" : "left";
    ctx.fillText(mark.label, at + (left ? -4 : 4) * devicePixelRatio, u.bbox.top + (mark.row ?? 1) * 13 * devicePixelRatio);
  }
  ctx.restore();
}

// A scatter with axes, as SVG: few points, each with a title that a screen reader and a mouse find.
export function scatter({ label, x, y, points, width = 520, height = 300, lines = [], bands = [], xlog = false, ylog = false, equal = false }) {
  const pad = { l: 68, r: 12, t: 10, b: 38 };
  const xs = [...points.map((p) => p.x), ...lines.flatMap((l) => l.points.map((p) => p[0])), ...bands.flatMap((b) => b.points.map((p) => p[0]))].filter(Number.isFinite);
  const ys = [...points.map((p) => p.y), ...lines.flatMap((l) => l.points.map((p) => p[1])), ...bands.flatMap((b) => b.points.map((p) => p[1]))].filter(Number.isFinite);
  let [x0, x1] = span(xs), [y0, y1] = span(ys, ylog);
  if (equal) {
    const unit = Math.max((x1 - x0) / (width - pad.l - pad.r), (y1 - y0) / (height - pad.t - pad.b));
    const cx = (x0 + x1) / 2, cy = (y0 + y1) / 2, w = unit * (width - pad.l - pad.r) / 2, hh = unit * (height - pad.t - pad.b) / 2;
    [x0, x1, y0, y1] = [cx - w, cx + w, cy - hh, cy + hh];
  }
  const fy = ylog ? Math.log10 : (v) => v;
  const px = (v) => pad.l + (v - x0) / (x1 - x0) * (width - pad.l - pad.r);
  const py = (v) => height - pad.b - (fy(v) - fy(y0)) / (fy(y1) - fy(y0)) * (height - pad.t - pad.b);
  const root = s("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", "aria-label": label });
  for (const t of ticks(x0, x1)) {
    root.append(s("line", { class: "grid-line", x1: px(t), x2: px(t), y1: pad.t, y2: height - pad.b }), text(px(t), height - pad.b + 14, num(t, 4), "middle"));
  }
  for (const t of ylog ? decades(y0, y1) : ticks(y0, y1)) {
    root.append(s("line", { class: "grid-line", x1: pad.l, x2: width - pad.r, y1: py(t), y2: py(t) }), text(pad.l - 5, py(t) + 4, num(t, 3), "end"));
  }
  root.append(text((pad.l + width - pad.r) / 2, height - 6, x, "middle"));
  const yl = text(13, (pad.t + height - pad.b) / 2, y, "middle");
  yl.setAttribute("transform", `rotate(-90 13 ${(pad.t + height - pad.b) / 2})`);
  root.append(yl);
  for (const band of bands) root.append(s("polygon", { points: band.points.map((p) => `${px(p[0])},${py(p[1])}`).join(" "), style: `fill:var(${band.colour});opacity:.18` }));
  for (const line of lines) root.append(s("polyline", { points: line.points.map((p) => `${px(p[0])},${py(p[1])}`).join(" "), style: `fill:none;stroke:var(${line.colour});stroke-width:${line.width ?? 1.6};${line.dash ? "stroke-dasharray:5 4" : ""}` }, title(line.label || "")));
  for (const p of points) {
    const at = { cx: px(p.x), cy: py(p.y) };
    const style = p.hollow ? `fill:none;stroke:var(${p.colour});stroke-width:2` : `fill:var(${p.colour})`;
    const mark = p.cross
      ? s("path", { d: `M${at.cx - 5} ${at.cy - 5}l10 10m0 -10l-10 10`, style: `stroke:var(${p.colour});stroke-width:2.4;fill:none` })
      : s("circle", { ...at, r: p.r ?? 5, style });
    mark.append(title(p.label || ""));
    root.append(mark);
  }
  return root;
}

function title(content) { const node = s("title"); node.textContent = content; return node; }
function text(x, y, content, anchor) { const node = s("text", { x, y, "text-anchor": anchor }); node.textContent = content; return node; }
function span(values, log = false) {
  if (!values.length) return log ? [0.1, 10] : [0, 1];
  let low = Math.min(...values), high = Math.max(...values);
  if (log) return [low / 1.5, high * 1.5];
  const room = (high - low || Math.abs(high) || 1) * 0.08;
  return [low - room, high + room];
}
function ticks(low, high, count = 6) {
  const raw = (high - low) / count, size = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((m) => m * size).find((m) => m >= raw);
  const out = [];
  for (let t = Math.ceil(low / step) * step; t <= high + 1e-12; t += step) out.push(Math.abs(t) < step * 1e-6 ? 0 : Number(t.toPrecision(10)));
  return out;
}
function decades(low, high) {
  const out = [];
  for (let k = Math.floor(Math.log10(low)); k <= Math.ceil(Math.log10(high)); k++) for (const m of [1, 3]) {
    const t = m * 10 ** k;
    if (t >= low && t <= high) out.push(t);
  }
  return out;
}

export class Portrait {
  // a signal against itself a quarter of a period earlier: a limit cycle is a closed loop
  constructor(label) {
    this.canvas = h("canvas", { class: "free", role: "img", "aria-label": label, height: 230 });
  }
  clear() { this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height); }
  draw(xs, ys, name, unit) {
    const { canvas } = this, width = canvas.clientWidth || 230, height = 230;
    const ratio = devicePixelRatio || 1;
    canvas.width = width * ratio; canvas.height = height * ratio; canvas.style.height = `${height}px`;
    const ctx = canvas.getContext("2d");
    ctx.scale(ratio, ratio);
    const reach = Math.max(1e-12, ...xs.map(Math.abs), ...ys.map(Math.abs)); // one scale for both
    const side = Math.min(width, height) / 2 - 12;
    ctx.strokeStyle = css("--grid");
    ctx.beginPath(); ctx.moveTo(width / 2, 4); ctx.lineTo(width / 2, height - 4); ctx.moveTo(width / 2 - side, height / 2); ctx.lineTo(width / 2 + side, height / 2); ctx.stroke();
    ctx.fillStyle = css("--soft"); ctx.font = "11px system-ui";
    ctx.fillText("¼ period earlier", width / 2 + 5, 13);
    ctx.textAlign = "right"; ctx.fillText(`${name} ${num(reach, 3)} ${unit}`, width - 2, height / 2 - 5);
    ctx.strokeStyle = css("--c1"); ctx.lineWidth = 1.2; ctx.beginPath();
    for (let i = 0; i < xs.length; i++) {
      const px = width / 2 + xs[i] / reach * side, py = height / 2 - ys[i] / reach * side;
      if (i) ctx.lineTo(px, py); else ctx.moveTo(px, py);
    }
    ctx.stroke();
  }
}
