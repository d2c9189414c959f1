// The REST API: one function, errors as exceptions that carry the problem's own words.
import { toast } from "./dom.js";

const BASE = "/api/v1";
let askedForKey = null;

export class Problem extends Error {
  constructor(body, status) {
    super(body.detail || body.title || `HTTP ${status}`);
    this.status = status;
    this.type = body.type || "";
    this.body = body;
  }
}

const tokens = JSON.parse(sessionStorage.getItem("entrain.tokens") || "{}");
export const controlToken = (rig) => tokens[rig] || null;
export function keepToken(rig, token) {
  if (token) tokens[rig] = token; else delete tokens[rig];
  sessionStorage.setItem("entrain.tokens", JSON.stringify(tokens));
}

export function key() { return sessionStorage.getItem("entrain.key"); }

export async function api(method, path, { body, rig, raw = false, query } = {}) {
  const headers = {};
  if (key()) headers["Authorization"] = `Bearer ${key()}`;
  if (rig && controlToken(rig)) headers["X-Control-Token"] = controlToken(rig);
  let content;
  if (body instanceof Blob) content = body;
  else if (body !== undefined) { headers["Content-Type"] = "application/json"; content = JSON.stringify(body); }
  const search = query ? "?" + new URLSearchParams(Object.entries(query).filter(([, v]) => v !== null && v !== undefined && v !== "")) : "";
  let answer;
  try {
    answer = await fetch(BASE + path + search, { method, headers, body: content });
  } catch (error) {
    throw new Problem({ detail: "the service does not answer" }, 0);
  }
  if (raw && answer.ok) return answer;
  if (answer.status === 204 || answer.status === 304) return null;
  const json = await answer.json().catch(() => ({}));
  if (answer.status === 401) { await askForKey(); if (key()) return api(method, path, { body, rig, raw, query }); }
  if (!answer.ok) throw new Problem(json, answer.status);
  return json;
}

export const get = (path, query) => api("GET", path, { query });
export const post = (path, body = {}, rig = null) => api("POST", path, { body, rig });

export async function attempt(work, done) {
  try {
    const result = await work();
    if (done) toast(done);
    return result;
  } catch (error) {
    toast(error.message, true);
    return null;
  }
}

export function askForKey() {
  if (askedForKey) return askedForKey;
  const dialog = document.getElementById("keydialog");
  askedForKey = new Promise((resolve) => {
    dialog.addEventListener("close", () => {
      const value = document.getElementById("key").value.trim();
      if (value) sessionStorage.setItem("entrain.key", value);
      document.getElementById("key").value = "";
      askedForKey = null;
      resolve();
    }, { once: true });
    dialog.showModal();
  });
  return askedForKey;
}

export async function download(path, name) {
  const answer = await api("GET", path, { raw: true });
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await answer.blob());
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10000);
}
