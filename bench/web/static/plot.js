// Small plots as SVG, drawn by hand: axes with round numbers, curves, points.

import { draw } from "./dom.js";
import { number } from "./units.js";

const LEFT = 50;
const BOTTOM = 36;
const TOP = 10;
const RIGHT = 10;

export function frame({ x, y, width: W = 420, height = 230, equal = false, label, xName, yName }) {
  let [x0, x1] = padded(x);
  let [y0, y1] = padded(y);
  const inner = [W - LEFT - RIGHT, height - TOP - BOTTOM];
  if (equal) {
    const size = Math.max((x1 - x0) / inner[0], (y1 - y0) / inner[1]);
    [x0, x1] = widened(x0, x1, size * inner[0]);
    [y0, y1] = widened(y0, y1, size * inner[1]);
  }
  const at = (a, b) => [LEFT + (inner[0] * (a - x0)) / (x1 - x0), TOP + (inner[1] * (y1 - b)) / (y1 - y0)];
  const plot = draw("svg", { class: "plot", viewBox: `0 0 ${W} ${height}`, role: "img", "aria-label": label });
  for (const tick of ticks(x0, x1, 5)) {
    const [px] = at(tick.value, y0);
    plot.append(draw("path", { class: "axis", d: `M${px} ${TOP}V${TOP + inner[1]}` }),
      draw("text", { x: px, y: TOP + inner[1] + 16, "text-anchor": "middle" }, tick.text));
  }
  for (const tick of ticks(y0, y1, 4)) {
    const [, py] = at(x0, tick.value);
    plot.append(draw("path", { class: "axis", d: `M${LEFT} ${py}H${LEFT + inner[0]}` }),
      draw("text", { x: LEFT - 5, y: py + 4, "text-anchor": "end" }, tick.text));
  }
  plot.append(draw("text", { x: LEFT + inner[0], y: height - 2, "text-anchor": "end" }, xName),
    draw("text", { x: LEFT + 4, y: TOP + 10 }, yName));
  return { plot, at };
}

export function curve({ plot, at }, points, kind) {
  const d = points.map(([a, b], index) => `${index ? "L" : "M"}${at(a, b).map((v) => v.toFixed(1)).join(" ")}`).join("");
  plot.append(draw("path", { class: `curve ${kind}`, d }));
}

export function dot({ plot, at }, [a, b], kind, r = 3.5) {
  const [cx, cy] = at(a, b);
  plot.append(draw("circle", { class: `dot ${kind}`, cx, cy, r }));
}

export function mark({ plot, at }, [a, b], kind, r = 6) {
  const [cx, cy] = at(a, b);
  plot.append(draw("circle", { class: kind, cx, cy, r }));
}

function padded(values) {
  const low = Math.min(...values);
  const high = Math.max(...values);
  const room = 0.06 * (high - low) || 0.5;
  return [low - room, high + room];
}

function widened(low, high, size) {
  const more = (size - (high - low)) / 2;
  return [low - more, high + more];
}

function ticks(low, high, count) {
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((one) => one * power).find((one) => one >= raw);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  const found = [];
  for (let value = Math.ceil(low / step) * step; value <= high; value += step) {
    found.push({ value, text: number(Math.abs(value) < step / 1e6 ? 0 : value, digits) });
  }
  return found;
}
