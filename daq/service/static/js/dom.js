// Small helpers: elements without markup strings (so nothing from outside becomes markup), numbers, toasts.

export function h(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else if (name === "class") node.className = value;
    else if (name in node && typeof value !== "string") node[name] = value;
    else node.setAttribute(name, value === true ? "" : value);
  }
  node.append(...children.flat().filter((child) => child !== null && child !== undefined && child !== false));
  return node;
}

export function s(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children.filter(Boolean));
  return node;
}

export function num(value, digits = 4) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (typeof value !== "number") return String(value);
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-3) return value.toExponential(Math.max(1, digits - 2)).replace("e+", "e");
  return String(Number(value.toPrecision(digits)));
}

// a relative error
export const percent = (value) => (Number.isFinite(value) ? `${num(100 * value, 3)} %` : "–");

// m⁻² for m^-2, nothing for 1
export function unit(name) {
  return name === "1" ? "" : name.replace(/\^(-?\d+)/g, (_, power) => [...power].map((c) => "⁻⁰¹²³⁴⁵⁶⁷⁸⁹"["-0123456789".indexOf(c)]).join(""));
}

// A value to the second digit of its standard error, both with one exponent: as the report writes it.
export function withError(value, stderr) {
  if (!Number.isFinite(value)) return "—";
  if (!Number.isFinite(stderr)) return `${num(value, 4)} ± not determined`;
  if (stderr <= 0) return `${num(value, 6)} ± 0`;
  const magnitude = Math.floor(Math.log10(Math.max(Math.abs(value), stderr)));
  const last = Math.floor(Math.log10(stderr)) - 1;  // decimal place of the error's second digit
  const plain = magnitude >= -4 && magnitude <= 5;
  const places = Math.min(100, Math.max(0, (plain ? 0 : magnitude) - last));
  const written = (x) => (plain ? x.toFixed(places) : `${(x / 10 ** magnitude).toFixed(places)}e${magnitude}`);
  return `${written(value)} ± ${written(stderr)}`.replaceAll("-", "−");
}

// a probability; what is too small for a double is said so
export function chance(p) { return p !== null && p < 1e-300 ? "< 1e-300" : num(p, 3); }

export function table(caption, head, rows, { pick, numeric = [], empty = "nothing yet" } = {}) {
  const body = rows.map((row, i) => {
    const cells = row.map((cell, k) => h("td", { class: numeric.includes(k) ? "n" : null, "data-head": head[k] || null }, cell ?? "–"));
    return h("tr", {}, cells);
  });
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": caption || "table" },
    h("table", { class: "rows" }, caption ? h("caption", {}, caption) : null,
      head.some(Boolean) && h("thead", {}, h("tr", {}, head.map((text, k) => h("th", { scope: "col", class: numeric.includes(k) ? "n" : null }, text)))),
      h("tbody", {}, body.length ? body : h("tr", {}, h("td", { colspan: String(head.length), class: "soft" }, empty)))));
}

export function card(width, title, ...children) {
  return h("section", { class: `card ${width}`, "aria-label": title }, h("h2", {}, title), ...children);
}

export function toast(text, bad = false) {
  const box = document.getElementById("toast");
  const item = h("div", { class: bad ? "bad" : "" }, text);
  box.append(item);
  setTimeout(() => item.remove(), bad ? 12000 : 5000);
}

export function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}
