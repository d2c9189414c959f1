// The page: a hash router, the stop button, the connection's state. Views draw themselves.
import { attempt, get, post } from "./api.js";
import { h, toast } from "./dom.js";
import * as model from "./model.js";
import { recolour } from "./plot.js";
import * as stream from "./stream.js";
import admin from "./views/admin.js";
import campaign from "./views/campaign.js";
import history_ from "./views/history.js";
import jobs from "./views/jobs.js";
import live from "./views/live.js";
import plan from "./views/plan.js";
import result from "./views/result.js";
import rigs from "./views/rigs.js";
import run from "./views/run.js";

const routes = { live, new: plan, history: history_, campaign, run, jobs, rigs, result, admin };
const main = document.getElementById("main");
let leave = null, asked = 0, failed = false;

async function nowhere(name) {
  return { title: "No such view", content: h("p", {}, `This page has no view «${name}». `, h("a", { href: "#live" }, "To Live")) };
}

async function show() {
  const turn = ++asked;
  const [name, ...rest] = decodeURI(location.hash.slice(1) || "live").split("/");
  const view = Object.hasOwn(routes, name) ? routes[name] : () => nowhere(name);
  for (const link of document.querySelectorAll("nav a")) {
    if (link.getAttribute("href") === `#${name}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  if (leave) leave();
  leave = null;
  main.replaceChildren(h("p", { class: "soft" }, "loading …"));
  let found;
  try {
    found = await view(rest.map(decodeURIComponent));
  } catch (error) {
    found = { title: "Not possible", content: h("p", { class: "bad", role: "alert" }, error.message), error };
  }
  // A slow answer may come when another view has been asked for.
  if (turn !== asked) { found.close?.(); return; }
  main.replaceChildren(h("h1", {}, found.title), ...[].concat(found.content));
  document.title = `${found.title} · entrain`;
  leave = found.close || null;
  failed = Boolean(found.error);
}

export async function stopAll() {
  try {
    const answer = await post("/emergency-stop");
    const unsure = Object.entries(answer.confirmed).filter(([, yes]) => !yes).map(([rig]) => rig);
    toast(unsure.length ? `Stop sent; not confirmed yet by ${unsure.join(", ")}` : "Silent: every rig is stopped. Reset it under Rigs.", unsure.length > 0);
  } catch (error) {
    toast(`STOP DID NOT REACH THE SERVICE: ${error.message}. Use the hardware switch.`, true);
  }
}

document.getElementById("stop").addEventListener("click", stopAll);
document.addEventListener("keydown", (event) => {
  if (event.key === "Escape" && model.anyRunning() && !document.querySelector("dialog[open]")) stopAll();
});
document.getElementById("skip").addEventListener("click", (event) => { event.preventDefault(); main.focus(); });

const theme = localStorage.getItem("entrain.theme") || (matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light");
document.documentElement.dataset.theme = theme;
document.getElementById("theme").addEventListener("click", () => {
  const next = document.documentElement.dataset.theme === "dark" ? "light" : "dark";
  document.documentElement.dataset.theme = next;
  localStorage.setItem("entrain.theme", next);
  recolour();
});

stream.on("connection", ({ state, lostAt }) => {
  const chip = document.getElementById("connection"), banner = document.getElementById("banner");
  const lost = state !== "connected";
  chip.textContent = lost ? "connection lost" : "connected";
  chip.className = `chip ${lost ? "bad" : "good"}`;
  banner.hidden = !lost;
  banner.textContent = lost ? `Connection lost at ${lostAt.toLocaleTimeString()}: what you see is old. A campaign goes on without this page; STOP may not reach it.` : "";
  document.body.classList.toggle("stale", lost);
});
stream.on("resumed", () => { if (failed) show(); });
stream.on("emergency_stop", (event) => toast(`Emergency stop by ${event.data.who}: ${event.data.rigs.join(", ")}`, true));
stream.on("control", (event) => { if (event.data.previous && event.data.holder !== event.data.previous) toast(`Control of ${event.data.rig}: ${event.data.holder || "free"}`); });
stream.on("dropped", (event) => toast(`This page lagged: ${event.data.dropped} events were left out`, true));

addEventListener("hashchange", async () => {
  await show();
  // Who reads by ear or key starts at the new view's top, not where the link was.
  if (!document.querySelector("dialog[open]")) main.focus({ preventScroll: true });
});
model.start();
const me = await attempt(() => get("/me"));
document.getElementById("adminlink").hidden = !me?.scopes.includes("admin");
stream.start();
show();
