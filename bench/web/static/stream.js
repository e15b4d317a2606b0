// Messages of the bench, and whether they are current: a page shows the loss of its bench within 2 s.

import { set } from "./dom.js";

const SILENT = 1.5; // s
const LOOK = 200; // ms
const watchers = new Map();
let source = null;
let link = { silent: Infinity, at: -Infinity, before: false };
let lostSince = null;
let refused = false;

export const on = (topic, action) => watchers.set(topic, action);
export const isLive = () => !document.body.classList.contains("stale");

export function startStream(topics) {
  const open = () => {
    source = new EventSource("/api/stream");
    for (const topic of topics) source.addEventListener(topic, (event) => receive(topic, event.data));
    source.addEventListener("error", () => {
      // The server refused (not signed in or too many pages): retry later. Else the browser reconnects itself.
      if (source !== null && source.readyState === EventSource.CLOSED) {
        close();
        refused = true;
        watchers.get("refused")?.();
        setTimeout(reopen, 2000);
      }
    });
  };
  const close = () => { source?.close(); source = null; };
  const reopen = () => { if (source === null && !document.hidden) open(); };
  // A hidden page takes no connection: a browser has six for one server, and a stop needs one.
  document.addEventListener("visibilitychange", () => (document.hidden ? close() : reopen()));
  setInterval(look, LOOK);
  reopen();
  return () => { close(); reopen(); };
}

function receive(topic, text) {
  const content = JSON.parse(text);
  refused = false;
  if (topic === "link") {
    link = { silent: content.silent_s ?? Infinity, at: performance.now(), before: content.silent_s !== null };
    look();
  }
  watchers.get(topic)?.(content);
}

function look() {
  const since = (performance.now() - link.at) / 1000;
  const silence = link.silent + since;
  const lost = !(silence < SILENT);
  document.body.classList.toggle("stale", lost);
  if (!lost) {
    lostSince = null;
    set("lost", "");
    set("link", "connected");
    return;
  }
  lostSince ??= new Date(Date.now() - (Number.isFinite(silence) ? 1000 * silence : 0));
  const when = lostSince.toLocaleTimeString();
  const place = since < SILENT ? "The bench is silent" : refused ? "Not signed in, or too many open pages," : "This page has lost its server";
  set("link", "not connected");
  set("lost", link.at === -Infinity
    ? "No figures yet: this page connects, or needs a sign-in, or too many pages are open."
    : link.before
      ? `${place} since ${when}. Grey figures are from that time. Stop may not arrive: use the emergency stop.`
      : `No bench has answered since ${when}. Start it: golfbench run.`);
}
