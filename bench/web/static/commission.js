// Commissioning as a guided form: choose a robot, check, start, follow the steps, repair, resume, read the report.

import { by, make, rows, set } from "./dom.js";
import { isOperator, outcome, randomNumber } from "./operate.js";
import { COMMAND_TIME, say, send } from "./send.js";
import { duration } from "./state.js";

const CONFIGURED = "as configured";
const opened = new Set();
let view = null;
let checked = null;
let busy = false;
let said = null;

export function startCommissioning() {
  by("robot-file").addEventListener("change", () => show(null));
  by("commission-check").addEventListener("click", check);
  by("commission-start").addEventListener("click", () => begin(by("robot-file").value, "", ""));
  setInterval(refresh, 300);
}

export function showCommissioning(content) {
  view = content;
  by("commission-card").hidden = false;
  const chosen = by("robot-file").value;
  rows("robot-file", ["", ...view.robots], option);
  if (["", ...view.robots].includes(chosen)) by("robot-file").value = chosen;
  set("robot-folder", `Other robots: configurations in ${view.folder}.`);
  redraw();
}

export function showCommissioner(content) {
  said = content;
  redraw();
}

const option = (name) => make("option", { value: name }, name || CONFIGURED);
const isRunning = () => view !== null && view.commissionings.some((one) => one.process !== null);

// It needs no bench: the robot is simulated.
function refresh() {
  const free = isOperator() && !busy && !said?.running; // a process may still end after its words
  const may = free && !isRunning();
  by("commission-check").disabled = !may;
  by("commission-start").disabled = !(may && checked !== null);
  for (const button of document.querySelectorAll("#commissionings button")) button.disabled = !("stop" in button.dataset ? isOperator() : free);
}

function redraw() {
  if (view === null) return;
  const ended = said && !said.running && said.text ? said : null;
  by("commission-ended").classList.toggle("bad", ended !== null);
  // The machine's own fault stands at its step; any other end is said here.
  const known = ended && view.commissionings.some((one) => one.name === ended.what && one.wrong);
  set("commission-ended", ended && !known && !isRunning() ? `${ended.what} has ended. ${ended.text}` : "");
  rows("commissionings", view.commissionings, one);
  refresh();
}

async function check() {
  busy = true;
  refresh();
  tell("Checking …", false);
  const robot = by("robot-file").value;
  const answer = await send("/api/commissioning/check", { robot, resume: "", repaired: "" }, "", COMMAND_TIME);
  busy = false;
  tell(answer.ok ? "" : say(answer, ""), !answer.ok);
  show(answer.ok && by("robot-file").value === robot ? answer : null);
}

function tell(text, bad) {
  set("commission-said", text);
  by("commission-said").classList.toggle("bad", bad);
}

function show(found) {
  checked = found;
  by("commission-preview").replaceChildren(...(found === null ? [] : [
    make("p", {}, "Check passed. Steps, each within its bounds:"),
    make("ol", { class: "steps numbered", start: 0 }, ...found.steps.map((step) => make("li", {}, step.title, make("br"), make("span", { class: "muted" }, step.bounds)))),
  ]));
  refresh();
}

async function begin(robot, resume, repaired) {
  busy = true;
  refresh();
  const answer = await send("/api/commissioning/start", { number: randomNumber(), robot, resume, repaired });
  busy = false;
  tell(say(answer, answer.note), !answer.ok);
  outcome(say(answer, answer.note), !answer.ok);
  if (answer.ok) show(null);
}

async function stop(name) {
  const answer = await send("/api/commissioning/stop", { number: randomNumber(), name });
  tell(say(answer, answer.note), !answer.ok);
}

function one(c, index) {
  const part = make("details", { open: index === 0 || opened.has(c.name) }, make("summary", {}, c.name, " ", make("span", { class: "muted" }, words(c))));
  part.addEventListener("toggle", () => (part.open ? opened.add(c.name) : opened.delete(c.name)));
  if (c.unreadable) {
    part.append(make("p", { class: "bad" }, c.unreadable));
    return part;
  }
  part.append(make("p", { class: "muted" }, `Robot: ${c.robot || CONFIGURED}, simulated`),
    make("progress", { max: c.steps.length, value: c.done, "aria-label": "Steps done" }),
    make("ol", { class: "steps marked", start: 0 }, ...c.steps.map((s, at) => step(s, at === c.done ? state(c) : ""))));
  if (c.wrong) part.append(wrong(c.wrong));
  part.append(make("div", { class: "row" }, ...actions(c)));
  return part;
}

const state = (c) => (c.process !== null ? "now" : c.wrong ? "wrong" : "next");
const finished = (c) => c.steps.length > 0 && c.done === c.steps.length;

function words(c) {
  if (c.unreadable) return "cannot be read";
  if (finished(c)) return "all steps done";
  const steps = `${c.done} of ${c.steps.length} steps done`;
  return c.process !== null ? `running, ${steps}` : c.wrong ? `machine fault, ${steps}` : `not running, ${steps}`;
}

const MARKS = { now: "➜ ", wrong: "✗ ", next: "· ", "": "· " };

function step(s, at) {
  const found = s.done ? ` ${s.values} values, ${duration(s.seconds)} of the bench` : at === "now" ? " being measured …" : "";
  return make("li", { class: s.done ? "done" : at === "wrong" ? "bad" : at || null, "aria-current": at === "now" ? "step" : null },
    s.done ? "✓ " : MARKS[at], s.title, make("span", { class: "muted" }, found),
    s.notes.length ? make("ul", { class: "words" }, ...s.notes.map((text) => make("li", { class: "muted" }, text))) : "");
}

function wrong(w) {
  return make("div", { class: "prompt", role: "alert" }, make("p", {}, make("strong", {}, `Machine fault: ${w.location}`)),
    make("p", {}, `Found ${w.found}; expected ${w.expected}.`), make("p", {}, w.action));
}

function actions(c) {
  const link = (kind, text, more) => (c.files.includes(kind) ? [make("a", { href: `/commissioning/${encodeURIComponent(c.name)}/${kind}`, ...more }, text)] : []);
  const files = [...link("report", finished(c) ? "Report to sign" : "Report so far", { target: "_blank", rel: "noopener" }), ...link("robot", "robot.toml", { download: `${c.name}.toml` })];
  if (c.process !== null) return [button("Stop", c, () => stop(c.name)), ...files];
  if (finished(c) || isRunning()) return files;
  const robots = make("select", { "aria-label": `Robot of ${c.name}` }, ...["", ...view.robots].map(option));
  robots.value = view.robots.includes(c.robot) ? c.robot : "";
  const repaired = make("input", { maxlength: 200, required: true, placeholder: "parts, or: nothing" });
  const resume = () => repaired.reportValidity() && begin(robots.value, c.name, repaired.value);
  return [make("label", {}, c.wrong ? "Repaired robot " : "Robot ", robots), make("label", {}, "Repaired since ", repaired),
    button("Resume", c, resume), ...files];
}

const button = (label, c, act) => make("button", { type: "button", "data-stop": label === "Stop", "aria-label": `${label} ${c.name}`, on: { click: act } }, label);
