// The state in words, the robot, the loop, the events.

import { by, make, pair, rows, set } from "./dom.js";
import { degrees, micro, number, onUnits, quantity } from "./units.js";

let view = null;

export function showState(content) {
  view = content;
  set("bench", view.bench);
  const title = `${view.state} – bench ${view.bench}`;
  if (document.title !== title) document.title = title;
  by("state").dataset.tone = view.tone;
  set("state-word", view.state);
  set("state-words", view.words);
  set("phase", [view.phase, view.reaction].filter(Boolean).join("; "));
  set("next", view.next);
  by("cause-line").hidden = view.cause === null;
  by("latest-line").hidden = view.latest_cause === null;
  set("cause", view.cause?.what ?? "");
  set("action", view.cause?.action ?? "");
  set("latest", view.latest_cause ? `${view.latest_cause.what} ${view.latest_cause.action}` : "");
  rows("warnings", view.warnings, (text) => make("li", {}, text));
  rows("conditions", view.conditions, ({ text, holds }) => make("li", { class: holds ? null : "not" }, holds ? "✓ " : "✗ ", text));
  figures();
}

function figures() {
  if (view === null) return;
  rows("robot", [
    ...view.joints.map((joint) => [joint.name, degrees(joint.deg)]),
    ["Supply", quantity("pressure", view.supply_pressure_pa)],
    ...view.chambers.map((one) => [`${one.name} A / B`, `${quantity("pressure", one.a_pa)} / ${quantity("pressure", one.b_pa)}`]),
    ["Vents", view.vents],
    ["Shut-off valve", view.shut_off],
    ["Ball on the tee", view.ball_present ? "yes" : "no"],
    ["Club", view.club],
    ["Swings", `${view.swings} of ${view.profile}${view.correction ? ", corrected" : ""}`],
    ["Driver", view.driver],
  ], pair);
  const loop = view.loop;
  rows("loop", [
    ["Rate", `${number(loop.rate_hz, 1)} Hz`],
    ["Wake-up latency p50 / p99", `${micro(loop.wake_p50_s)} / ${micro(loop.wake_p99_s)}`],
    ["Work, p99", micro(loop.tick_p99_s)],
    ["Skipped, late ticks", `${loop.skipped}, ${loop.late}`],
    ["Tick", String(view.tick)],
    ["Up", duration(view.uptime)],
  ], pair);
}

onUnits(figures);

export function duration(seconds) {
  if (typeof seconds !== "number") return "–";
  const total = Math.round(seconds);
  const [h, m, s] = [Math.floor(total / 3600), Math.floor(total / 60) % 60, total % 60];
  return h ? `${h} h ${m} min` : m ? `${m} min ${s} s` : `${s} s`;
}

export function showEvents(events) {
  const lines = events.map((event) => {
    const known = event.event === "change"
      ? [event.state, event.phase, event.reaction === "NONE" ? "" : event.reaction, event.cause === "NONE" ? "" : event.cause]
      : [event.event, event.text ?? ""];
    return [new Date(event.at_utc).toLocaleTimeString(), known.filter(Boolean).join(", ")];
  });
  rows("events", lines.reverse(), ([at, text]) => make("li", {}, make("time", {}, at), " ", text));
}
