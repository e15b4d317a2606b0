// Two recorded swings over each other, and what wears.

import { make } from "./dom.js";
import { curve, dot, frame } from "./plot.js";
import { SIZE, figure } from "./swing.js";
import { degrees, number, quantity, scale } from "./units.js";

const FIGURES = [
  ["Club speed", "club_speed_mps", (value) => quantity("speed", value)],
  ["Attack", "attack_angle_deg", (value) => degrees(value, 2)],
  ["Strike, toe", "strike_x_mm", (value) => `${number(value, 1)} mm`],
  ["Strike, up", "strike_y_mm", (value) => `${number(value, 1)} mm`],
  ["Ball speed", "ball_speed_mps", (value) => quantity("speed", value)],
  ["Launch", "launch_angle_deg", (value) => degrees(value, 2)],
  ["Spin", "spin_rpm", (value) => `${number(value, 0)} rpm`],
  ["Carry", "carry_m", (value) => quantity("distance", value)],
];

const table = (head, body) => make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": head[0] },
  make("table", {}, make("thead", {}, make("tr", {}, ...head.map((text) => make("th", { scope: "col" }, text)))),
    make("tbody", {}, ...body.map((row) => make("tr", {}, ...row.map((text) => make("td", {}, text)))))));

// Clocks are aligned at the ball.
export function overlay(views) {
  const key = views.map((view, index) => [`k${index + 1}`, view.name.replace(".parquet", "")]);
  const shown = FIGURES.map(([name, field, words]) => {
    const [a, b] = views.map((view) => view.figures[field]);
    return [name, words(a), words(b), typeof a === "number" && typeof b === "number" ? words(b - a) : "–"];
  });
  const plots = make("div", { class: "plots" });
  if (views.every((view) => view.path.length)) {
    const since = views.map((view) => view.time.map((time) => time - view.time[view.to_ball - 1]));
    const [factor, unit] = scale("speed");
    plots.append(lines(views.map((view, k) => view.speed.curve.map((v, at) => [since[k][at], factor * v])), "Club head speed", unit, key));
    views[0].tracking.forEach(({ name }, joint) => plots.append(lines(
      views.map((view, k) => view.tracking[joint].error_deg.slice(0, view.to_ball).map((v, at) => [since[k][at], v])), `Tracking error, ${name}`, "°", key)));
    plots.append(paths(views, key));
  }
  return make("div", { id: "overlay" }, table(["Figure", ...key.map(([, name]) => name), "difference"], shown), plots);
}

function lines(curves, title, unit, key) {
  const all = curves.flat();
  const plot = frame({ x: all.map(([x]) => x), y: all.map(([, y]) => y), ...SIZE, label: `${title} of both swings`, xName: "s to the ball", yName: unit });
  curves.forEach((points, index) => curve(plot, points, `l${index + 1}`));
  return figure(plot, title, key);
}

function paths(views, key) {
  const all = views.flatMap((view) => [...view.path, view.ball_at]);
  const plot = frame({ x: all.map(([x]) => x), y: all.map(([, y]) => y), ...SIZE, equal: true, label: "Paths of both club heads", xName: "m", yName: "m" });
  views.forEach((view, index) => curve(plot, view.path, `l${index + 1}`));
  dot(plot, views[0].ball_at, "l3", 5);
  return figure(plot, "Club head in the swing plane", key);
}

export function wearTable({ parts, swings }) {
  const worn = parts.filter((one) => Math.abs(one.latest) >= 0.25 * one.most);
  const rows = worn.map((one) => [one.part, one.value, `${number(one.latest, 2)} ± ${number(one.error, 2)} ${one.unit}`,
    `${number(one.most, 2)} ${one.unit}`, one.worn ? "worn" : one.swings_left === null ? "" : `in ${number(one.swings_left, 0)} swings`]);
  return make("div", { id: "wear" }, make("p", {}, `${swings} swings; ${parts.length - worn.length} other values hardly differ from the configuration.`),
    rows.length ? table(["Part", "value", "change", "worn from", "worn"], rows) : "");
}
