// The last swing, also while it runs: figures, head speed, tracking, pressures, club path.

import { by, make, pair } from "./dom.js";
import { curve, dot, frame } from "./plot.js";
import { degrees, number, onUnits, quantity, scale } from "./units.js";

export const SIZE = { width: 300, height: 210 };
let view = null;

export function showSwing(content) {
  view = content;
  redraw();
}

function redraw() {
  if (view === null) return;
  const f = view.figures;
  const facts = make("dl", { class: "big" }, ...[
    ["Club speed", quantity("speed", f.club_speed_mps)],
    ["Attack", degrees(f.attack_angle_deg, 2)],
    ["Strike, toe / up", `${number(f.strike_x_mm, 1)} / ${number(f.strike_y_mm, 1)} mm`],
    ["Ball speed", quantity("speed", f.ball_speed_mps)],
    ["Launch", degrees(f.launch_angle_deg)],
    ["Spin", typeof f.spin_rpm === "number" ? `${number(f.spin_rpm, 0)} rpm` : "–"],
    ["Carry", quantity("distance", f.carry_m)],
  ].map(pair));
  const when = view.time_utc ? new Date(view.time_utc).toLocaleString() : "";
  const source = view.sources.launch ? `launch: ${view.sources.launch}, carry: ${view.sources.carry}` : "";
  const name = view.stored ? `Swing ${view.number ?? "–"}` : `${view.running ? "Swing under way" : "Preliminary"}, record pending`;
  const line = make("p", { class: "muted" }, [name, when, view.club, view.ball, view.reason, source].filter(Boolean).join("; "));
  const plots = make("div", { class: "plots" });
  if (view.path.length) plots.append(speed(), tracking(), ...(view.pressures.length ? [pressures()] : []), path());
  by("swing").replaceChildren(line, facts, plots);
}

function path() {
  const all = [...view.path, view.ball_at];
  const plot = frame({
    x: all.map(([x]) => x), y: all.map(([, y]) => y), ...SIZE, equal: true,
    label: "Path of the club head in the swing plane", xName: "m", yName: "m",
  });
  curve(plot, view.path, "l1");
  if (view.down.length) curve(plot, view.down, "l2");
  dot(plot, view.ball_at, "l3", 5);
  return figure(plot, "Club head in the swing plane", [["k1", "whole swing"], ["k2", "downswing"], ["k3", "ball"]]);
}

function speed() {
  const [factor, unit] = scale("speed");
  const points = view.speed.curve.map((value, index) => [view.time[index], factor * value]);
  const plot = frame({ x: view.time, y: points.map(([, v]) => v), ...SIZE, label: "Speed of the club head over time", xName: "s", yName: unit });
  curve(plot, points, "l1");
  return figure(plot, `Club head speed, at most ${quantity("speed", view.speed.max_mps)}`, []);
}

function tracking() {
  const errors = view.tracking.map((joint) => joint.error_deg.slice(0, view.to_ball));
  const plot = frame({ x: view.time.slice(0, view.to_ball), y: errors.flat(), ...SIZE, label: "Tracking error of the joints over time", xName: "s", yName: "°" });
  errors.forEach((error, index) => curve(plot, error.map((e, at) => [view.time[at], e]), `l${index + 1}`));
  const key = view.tracking.map((joint, index) => [`k${index + 1}`, `${joint.name} ${degrees(joint.max_deg, 2)}`]);
  return figure(plot, "Tracking error up to the ball; max in the downswing", key);
}

function pressures() {
  const [factor, unit] = scale("pressure");
  const all = view.pressures.map((one) => one.pa.map((value) => factor * value));
  const plot = frame({ x: view.time, y: all.flat(), ...SIZE, label: "Pressures of the chambers over time", xName: "s", yName: unit });
  const names = [...new Set(view.pressures.map((one) => one.name))];
  all.forEach((values, index) => {
    const { name, side } = view.pressures[index];
    curve(plot, values.map((value, at) => [view.time[at], value]), `l${names.indexOf(name) + 1}${side === "B" ? " dash" : ""}`);
  });
  return figure(plot, "Pressures of chambers A, B dashed", names.map((name, index) => [`k${index + 1}`, name]));
}

export function figure({ plot }, title, key) {
  return make("figure", {}, plot, make("figcaption", {}, title),
    make("div", { class: "key" }, ...key.map(([kind, text]) => make("span", { class: kind }, "━ ", text))));
}

onUnits(redraw);
