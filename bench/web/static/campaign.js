// Running campaigns: progress, prompt, table by ball, control chart, and the requests to their runner.

import { ask } from "./ask.js";
import { by, make, pair } from "./dom.js";
import { mayOperate, operator, outcome, randomNumber } from "./operate.js";
import { curve, dot, frame, mark } from "./plot.js";
import { say, send } from "./send.js";
import { duration } from "./state.js";
import { figure } from "./swing.js";
import { degrees, number, onUnits, quantity, scale } from "./units.js";

export const KINDS = { carry_m: "distance", total_m: "distance", apex_m: "distance", ball_speed_mps: "speed", club_speed_mps: "speed" };
const REQUESTS = [
  ["pause", "Pause", "Pause after the current shot?"],
  ["resume", "Continue", "Continue? The bench locks the guard, warns, and arms."],
  ["stop", "Stop after this shot", "Stop the campaign after the current shot? It can be resumed."],
  ["abort", "Abort", "Abort the campaign at once? It cannot be resumed."],
];
let running = [];
let seen = 0;
let changed = () => {};

export const setSeen = (value) => { seen = value; };
export const onEnd = (action) => { changed = action; };

export function showCampaigns(content) {
  if (content.length < running.length) changed();
  running = content;
  redraw();
}

function redraw() {
  by("campaign-card").hidden = running.length === 0;
  // A person who types a comment keeps the words and the focus.
  const typed = new Map([...by("campaign").querySelectorAll("input")].map((one) => [one.id, one.value]));
  const focused = document.activeElement?.id;
  by("campaign").replaceChildren(...running.map(one));
  for (const [id, value] of typed) if (by(id)) by(id).value = value;
  if (focused?.startsWith("campaign-")) by(focused)?.focus();
}

function one({ progress: p, detail }) {
  const part = make("div", {});
  const prompted = detail?.prompt && p.reason === detail.prompt.text;  // otherwise the runner waits for access
  part.append(make("p", {}, make("strong", {}, p.campaign), ` ${p.state}${p.reason && !prompted ? `: ${p.reason}` : ""}`),
    prompted ? prompt(p.campaign, detail.prompt) : "",
    make("progress", { max: p.planned, value: p.done, "aria-label": "Shots done" }));
  part.append(make("dl", { class: "big" }, ...[
    ["Shots", `${p.done} of ${p.planned}`],
    ["Valid", String(p.valid)],
    ["Block", p.block ? `${p.block} of ${p.blocks}` : "warming up"],
    ["Left", duration(p.seconds_left)],
    ["Next work by hand", p.next_work ? `${p.next_work.text}, in ${p.next_work.shots} shots${p.next_work.seconds === null ? "" : ` (${duration(p.next_work.seconds)})`}` : "none"],
  ].map(pair)));
  part.append(requests(p), balls(p));
  if (p.last_shot) part.append(lastShot(p.campaign, p.last_shot));
  if (p.event) part.append(make("p", { class: "muted" }, `Latest event: ${p.event.text}`));
  if (detail?.interim) part.append(interim(detail.interim));
  if (detail) part.append(make("div", { class: "plots" }, ...detail.charts.map(chart)));
  return part;
}

const scaleOf = (column) => (KINDS[column] ? scale(KINDS[column]) : [1, column.split("_").pop(), 2]);

// State at the plan's last interim analysis: showing it costs no error rate.
function interim({ block, blocks, column, pairs }) {
  const [factor, unit, digits] = scaleOf(column);
  const words = (value) => number(factor * value, digits);
  return make("div", { class: "interim" }, make("p", {}, `After ${block} of ${blocks} blocks, at the plan's interim analysis:`),
    make("ul", { class: "words" }, ...pairs.map((one) => make("li", {}, `${one.first} − ${one.second}: ${words(one.difference)} ${unit} (${words(one.low)} to ${words(one.high)}), ${one.verdict}`))));
}

function prompt(campaign, waiting) {
  const field = make("input", { id: "campaign-balls", inputmode: "numeric", maxlength: 5, size: 5 });
  const count = waiting.places.length ? make("label", {}, "Balls loaded ", field) : "";
  const list = make("ol", {}, ...waiting.places.map((place) => make("li", {}, place)));
  const done = make("button", { type: "button", class: "yes", id: "campaign-answer", on: { click: async () => {
    const balls = field.value.trim() === "" ? null : Number(field.value);
    if (!(await ask("Is it done?", `${waiting.text} The bench then locks the guard, warns, and arms. Is everybody outside?`, "Done", mayOperate))) return;
    await request(campaign, "answer", { prompt: waiting.number, balls });
  } } }, "Done …");
  return make("div", { class: "prompt", role: "alert" }, make("p", {}, make("strong", {}, waiting.text)), list, make("div", { class: "row" }, count, done));
}

function requests(p) {
  const buttons = REQUESTS.filter(([name]) => name !== (p.state === "paused" ? "pause" : "resume"));
  return make("div", { class: "row" }, ...buttons.map(([name, label, text]) => make("button", { type: "button", id: `campaign-${name}`, on: { click: async () => {
    if (await ask(text, p.campaign, label, mayOperate)) await request(p.campaign, name, {});
  } } }, label)));
}

function balls(p) {
  const body = Object.entries(p.balls).map(([name, n]) => make("tr", {}, make("td", {}, name), make("td", {}, n.valid), make("td", {}, n.planned)));
  return make("table", {}, make("thead", {}, make("tr", {}, make("th", { scope: "col" }, "Ball"), make("th", { scope: "col" }, "valid"), make("th", { scope: "col" }, "planned"))), make("tbody", {}, ...body));
}

function lastShot(campaign, shot) {
  const comment = make("input", { id: "campaign-comment", maxlength: 200, placeholder: "observation" });
  const other = make("input", { id: "campaign-shot", inputmode: "numeric", maxlength: 6, size: 4, class: "short", placeholder: String(shot.shot) });
  const text = [`Shot ${shot.shot}`, shot.ball, shot.status, shot.reason, quantity("speed", shot.club_speed_mps), quantity("speed", shot.ball_speed_mps),
    degrees(shot.launch_angle_deg), `${number(shot.spin_rpm, 0)} rpm`, quantity("distance", shot.carry_m)].filter(Boolean).join(", ");
  return make("div", {}, make("p", {}, text), make("div", { class: "row" }, make("label", {}, "Shot ", other), make("label", {}, "Comment ", comment),
    make("button", { type: "button", id: "campaign-mark", on: { click: async () => {
      const number = other.value.trim() === "" ? shot.shot : Number(other.value);
      if (await request(campaign, "mark", { shot: number, comment: comment.value.trim() })) comment.value = other.value = "";
    } } }, "Mark")));
}

export async function request(campaign, name, more) {
  if (!operator()) { by("holder").focus(); outcome("Write your name first.", true); return false; }
  const answer = await send(`/api/campaign/${encodeURIComponent(campaign)}/${name}`, { number: randomNumber(), seen, by: operator(), ...more });
  outcome(say(answer, answer.note), !answer.ok);
  return answer.ok;
}

export function chart(c) {
  const [factor, unit, digits] = scaleOf(c.column);
  const points = c.values.map((value, index) => [c.shots[index], factor * value]);
  const limits = [-3, 0, 3].map((n) => factor * (c.centre + n * c.sd));
  const plot = frame({ x: c.shots, y: [...points.map(([, v]) => v), ...limits], label: `Control chart of ${c.column}`, xName: "shot", yName: unit });
  const ends = [Math.min(...c.shots), Math.max(...c.shots)];
  limits.forEach((limit, index) => curve(plot, ends.map((x) => [x, limit]), index === 1 ? "l3 dash" : "limit"));
  curve(plot, points, "l1");
  points.forEach((point) => dot(plot, point, "l1"));
  points.filter((_, index) => c.signals.includes(c.shots[index])).forEach((point) => mark(plot, point, "signal"));
  const name = c.column.replace(/_(m|mps)$/, "").replaceAll("_", " ");
  return figure(plot, `Control ball, ${name}: mean ${number(limits[1], digits)} ${unit}, ${c.signals.length} signals`, []);
}

onUnits(redraw);
