// The live stream: one WebSocket, resumed behind the last event seen, honest about silence.
import { api, get, key } from "./api.js";

const listeners = new Map();
let seq = 0, service = null, socket = null, lastHeard = 0, delay = 500, state = "connecting", lostAt = null;

export function on(kind, listener) {
  if (!listeners.has(kind)) listeners.set(kind, new Set());
  listeners.get(kind).add(listener);
  return () => listeners.get(kind).delete(listener);
}

function emit(kind, data) {
  for (const listener of listeners.get(kind) || []) listener(data);
}

function setState(next) {
  if (next === state) return;
  state = next;
  if (next === "lost") lostAt = new Date();
  emit("connection", { state, lostAt });
}

export const connection = () => ({ state, lostAt });

export function parse(buffer) {
  const view = new DataView(buffer);
  const length = view.getUint32(4, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 8, length)));
  return { ...head, samples: new Float32Array(buffer, 8 + length) };
}

async function open() {
  let query = `since=${seq}`;
  try {
    const health = await get("/health");
    if (health.key_needed || key()) {
      const pass = await api("POST", "/live/ticket", { body: {} });
      query += `&ticket=${encodeURIComponent(pass.ticket)}`;
    }
  } catch (error) {
    again();
    return;
  }
  socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/v1/live/ws?${query}`);
  socket.binaryType = "arraybuffer";
  socket.onmessage = (message) => {
    lastHeard = Date.now();
    delay = 500;
    const event = typeof message.data === "string" ? JSON.parse(message.data) : parse(message.data);
    if (event.kind === "hello") {
      if (service && service !== event.service) {  // started anew: its events are others, from 1 on
        service = null;
        seq = 0;
        emit("restarted", event);
        socket.close();
        return;
      }
      service = event.service;
      setState("connected");
      emit("resumed", event);
    }
    if (event.seq && event.kind !== "hello") seq = event.seq;
    emit(event.kind, event);
    emit("*", event);
  };
  socket.onclose = () => again();
}

function again() {
  socket = null;
  setState("lost");
  setTimeout(open, delay);
  delay = Math.min(5000, delay * 1.6);
}

export function start() {
  lastHeard = Date.now();
  open();
  setInterval(() => {
    // The service speaks at least once a second; longer silence is a lost connection.
    if (socket && socket.readyState === 1 && Date.now() - lastHeard > 4000) {
      socket.onclose = null;
      socket.close();
      again();
    }
  }, 1000);
}
