// Previous campaigns with their reports and landing points, and records to download.

import { ask } from "./ask.js";
import { by, make } from "./dom.js";
import { chart, request } from "./campaign.js";
import { mayOperate, outcome, randomNumber, releaseLease } from "./operate.js";
import { overlay, wearTable } from "./compare.js";
import { curve, dot, frame } from "./plot.js";
import { figure } from "./swing.js";
import { COMMAND_TIME, say, send } from "./send.js";
import { onUnits, quantity, scale, unitSystem } from "./units.js";

const POINTS = 60;
const PAUSE = 250; // ms after the last key of a search
let content = null;
let opened = null;
let chosen = [];
let laid = null; // comparison or wear of the chosen records

const look = (path) => fetch(path, { cache: "no-store" }).catch(() => null);

export async function loadArchive() {
  const search = by("archive-search").value.trim();
  const response = await look(search ? `/api/archive/${encodeURIComponent(search)}` : "/api/archive");
  if (!response?.ok) return;
  content = await response.json();
  redraw();
}

async function open(campaign) {
  const response = await look(`/api/campaign/${encodeURIComponent(campaign)}`);
  opened = response?.ok ? await response.json() : null;
  redraw();
}

function redraw() {
  if (content === null) return;
  by("archive-card").hidden = content.campaigns.length + content.records.length === 0 && !by("archive-search").value;
  by("archive").replaceChildren(campaigns(), detail(), records());
}

function campaigns() {
  if (!content.campaigns.length) return make("p", { class: "muted" }, "No campaigns yet.");
  const head = ["Campaign", "started", "state", "shots", "valid"].map((text) => make("th", { scope: "col" }, text));
  const body = content.campaigns.map((one) => make("tr", {},
    make("td", {}, one.title, make("br"), make("span", { class: "muted" }, one.id)),
    make("td", {}, new Date(one.date).toLocaleString()), make("td", {}, one.state), make("td", {}, one.shots), make("td", {}, one.valid),
    make("td", {}, make("button", { type: "button", on: { click: () => open(one.id) }, "aria-label": `Figures of ${one.id}` }, "Figures"), " ",
      one.report ? make("a", { href: `/report/${encodeURIComponent(one.id)}`, target: "_blank", rel: "noopener" }, "Report") : "",
      one.ended && !one.report && one.shots ? action("Write report", one.id, writeReport) : "",
      one.ended || one.runner ? "" : action("Resume", one.id, resume))));
  return make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Previous campaigns" }, make("table", {}, make("thead", {}, make("tr", {}, ...head, make("td", {}))), make("tbody", {}, ...body)));
}

const action = (label, id, act) => make("button", { type: "button", "aria-label": `${label} of ${id}`, on: { click: (event) => act(id, event.target) } }, label);

async function resume(id) {
  const text = "A runner takes the lease (one of this page is released, which disarms), locks the guard, warns, arms and swings automatically; it also resets and homes a simulated bench. Is everybody outside the guard, and the range clear?";
  if (!(await ask(`Resume ${id}?`, text, "Resume", mayOperate))) return;
  if (!(await releaseLease())) return;
  if (await request(id, "resume", { ask: by("plan-ask").checked })) loadArchive();
}

async function writeReport(id, button) {
  button.disabled = true;
  outcome(`Report of ${id}: being written …`, false);
  const answer = await send(`/api/campaign/${encodeURIComponent(id)}/report`, { number: randomNumber(), units: unitSystem() }, "", COMMAND_TIME);
  outcome(say(answer, answer.note), !answer.ok);
  loadArchive();
}

function detail() {
  if (opened === null) return "";
  const part = make("div", {}, make("h3", {}, opened.title), make("div", { class: "plots" }));
  part.lastChild.append(...opened.charts.map(chart), ...(opened.landing ?? []).filter((one) => one.points.length).map(landing));
  if (opened.landing === null) part.append(make("p", { class: "muted" }, "Landing points appear at the end: each look before costs confidence."));
  part.append(make("p", { class: "muted" }, `Report: golfbench campaign report ${opened.campaign}`));
  return part;
}

function landing({ section, points, ellipses }) {
  const [factor, unit] = scale("distance");
  const names = [...new Set(points.map((one) => one.level))];
  const kind = (name) => 1 + (names.indexOf(name) % 3);
  const outlines = ellipses.map((one) => [one.level, outline(one).map(([x, y]) => [factor * x, factor * y])]);
  const spots = points.map((one) => [one.level, [factor * one.side, factor * one.carry]]);
  const all = [...spots.map(([, at]) => at), ...outlines.flatMap(([, line]) => line)];
  const plot = frame({ x: all.map(([x]) => x), y: all.map(([, y]) => y), height: 300, equal: true, label: "Landing points and 95 % ellipses", xName: `offline, ${unit}`, yName: `carry, ${unit}` });
  outlines.forEach(([name, line]) => curve(plot, line, `l${kind(name)}`));
  spots.forEach(([name, at]) => dot(plot, at, `l${kind(name)}`, 3));
  const key = names.map((name) => {
    const found = ellipses.find((one) => one.level === name);
    return [`k${kind(name)}`, found ? `${name}: ${quantity("distance", found.long)} × ${quantity("distance", found.short)}` : name];
  });
  return figure(plot, `Landing points${section ? `, ${section}` : ""}; ellipses hold 95 %`, key);
}

// Half the long axis lies `tilt` to the right of the target line.
function outline({ centre, long, short, tilt }) {
  return Array.from({ length: POINTS + 1 }, (_, index) => {
    const angle = (2 * Math.PI * index) / POINTS;
    const [a, b] = [(long / 2) * Math.cos(angle), (short / 2) * Math.sin(angle)];
    return [centre[0] + a * Math.sin(tilt) + b * Math.cos(tilt), centre[1] + a * Math.cos(tilt) - b * Math.sin(tilt)];
  });
}

function records() {
  if (!content.records.length) return "";
  const list = content.records.map(({ name, bytes }) => make("li", {},
    make("label", { class: "check" }, make("input", { type: "checkbox", checked: chosen.includes(name), on: { change: (event) => choose(name, event.target.checked) } }), ` ${name}`),
    ` ${(bytes / 1e6).toFixed(1)} MB `, make("a", { href: `/record/${encodeURIComponent(name)}`, download: name, "aria-label": `Download ${name}` }, "Download")));
  const buttons = make("p", {},
    make("button", { type: "button", id: "lay-over", disabled: chosen.length !== 2, on: { click: layOver } }, "Lay two over each other"), " ",
    make("button", { type: "button", id: "wear-of", disabled: !chosen.length, on: { click: wear } }, "Wear of the chosen"));
  return make("div", {}, make("h3", {}, "Records of swings"), make("ul", { class: "events" }, ...list), buttons, laid === null ? "" : laid());
}

function choose(name, on) {
  chosen = on ? [...chosen, name] : chosen.filter((one) => one !== name);
  by("lay-over").disabled = chosen.length !== 2;
  by("wear-of").disabled = !chosen.length;
}

async function layOver() {
  const answers = await Promise.all(chosen.map((name) => look(`/api/swing/${encodeURIComponent(name)}`)));
  const views = await Promise.all(answers.map((one) => (one?.ok ? one.json() : null)));
  if (views.includes(null)) return outcome("One of the records cannot be read.", true);
  laid = () => overlay(views);
  redraw();
}

async function wear(event) {
  event.target.disabled = true;
  outcome("Wear: fitting the parts …", false);
  const answer = await send("/api/wear", { number: randomNumber(), records: chosen }, "", COMMAND_TIME);
  outcome(say(answer, answer.worn ? "A part is worn." : "No part is worn."), !answer.ok || answer.worn);
  if (answer.ok) laid = () => wearTable(answer);
  redraw();
}

let waiting = 0;
by("archive-search").addEventListener("input", () => {
  clearTimeout(waiting);
  waiting = setTimeout(loadArchive, PAUSE);
});
onUnits(redraw);
