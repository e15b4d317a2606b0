// Guided forms: the access for work by hand, the air, the calibrations.

import { by, make, rows, set } from "./dom.js";
import { mayOperate, operator, outcome, press, randomNumber } from "./operate.js";
import { COMMAND_TIME, say, send } from "./send.js";

let content = null;

// The access: each step with whether it is done, and the one to do now with its button.

const STEPS = [
  { text: "Disarm; wait until the robot rests and its chambers are vented.", done: (v) => v.state === "ACCESS" || (["READY", "SAFE", "ESTOP", "FAULT"].includes(v.state) && v.vented), name: "disarm" },
  { text: "Open the access: the guard unlocks.", done: (v) => v.state === "ACCESS", name: "access" },
  { text: "Enter, change club or ball, leave; close the guard.", done: () => false, name: "" },
  { text: "End the access: the guard locks. Then home or arm.", done: () => false, name: "secure" },
];

export function showAccess(view) {
  const open = view.state === "ACCESS";
  const at = open ? 2 : STEPS.findIndex((step) => !step.done(view));
  const now = (index) => index === at || (open && index === 3 && view.guard_closed);
  rows("access-steps", STEPS.map((step, index) => [step.text, now(index) ? "now" : index < at ? "done" : "", view.accepts.includes(step.name) ? step.name : ""]), ([text, mark, name]) =>
    make("li", { class: mark || null, "aria-current": mark === "now" ? "step" : null }, mark === "done" ? "✓ " : mark === "now" ? "➜ " : "· ", text, " ",
      mark === "now" && name ? make("button", { type: "button", id: `step-${name}`, on: { click: () => press(name) } }, LABELS[name]) : ""));
}

const LABELS = { disarm: "Disarm", access: "Open access", secure: "End access" };

// Forms for measured values: each is a command of golfbench, with its options; the command checks ranges.
// A field: option, label, unit; triple: one number for each joint.

const JOINTS = ["shoulder", "arm", "wrist"];
const FORMS = [
  {
    name: "air", title: "Air at the bench",
    steps: [
      "Read temperature, humidity and station pressure (not reduced to sea level) at the bench.",
      "Shots on hardware use the reading for one hour.",
    ],
    fields: [
      { name: "temperature", label: "Temperature", unit: "°C" },
      { name: "pressure", label: "Station pressure", unit: "hPa" },
      { name: "humidity", label: "Relative humidity", unit: "%" },
    ],
  },
  {
    name: "encoders", title: "Encoder zeros", lasting: true,
    steps: [
      "Disarm, open the access, and lock the robot at its mechanical reference.",
      "Enter the joint angles of that pose. The bench reads the counts itself while the robot is locked; enter them only if no bench runs.",
      "Unlock the robot, leave, end the access; restart the bench and home it.",
      "If one was mounted again, use golfbench calibrate encoders --remounted at the command line.",
    ],
    fields: [
      { name: "from-pose", label: "Angles of the reference", unit: "°", triple: true },
      { name: "uncertainty-deg", label: "Standard uncertainty", unit: "°" },
      { name: "counts", label: "Counts at that pose", unit: "counts", triple: true, optional: true },
      { name: "sign", label: "Signs, 1 or -1", triple: true, optional: true },
    ],
  },
  {
    name: "ball", title: "Position of the ball", lasting: true,
    steps: [
      "Disarm, open the access, and put a ball on its tee.",
      "Measure its centre in the swing plane from the shoulder axis R1.",
      "Leave, end the access, and enter the position; restart the bench.",
    ],
    fields: [
      { name: "x", label: "Towards the target, from R1", unit: "m" },
      { name: "y", label: "Up the swing plane, from R1", unit: "m" },
      { name: "uncertainty-mm", label: "Standard uncertainty of both", unit: "mm" },
    ],
  },
  {
    name: "club", title: "Club in its mount", lasting: true, club: true,
    steps: [
      "Disarm, open the access, and clamp the club.",
      "Measure from the wrist axis R3 to the centre of the face, and loft and lie as it sits.",
      "Leave, end the access, and enter the values; restart the bench.",
    ],
    fields: [
      { name: "length", label: "Wrist axis to the face", unit: "m" },
      { name: "loft-deg", label: "Loft", unit: "°" },
      { name: "lie-deg", label: "Lie", unit: "°" },
      { name: "length-uncertainty-mm", label: "Uncertainty of the length", unit: "mm" },
      { name: "angle-uncertainty-deg", label: "Uncertainty of the angles", unit: "°" },
    ],
  },
  {
    name: "valves", title: "Valve centres", lasting: true,
    steps: [
      "With everybody outside the guard, find for each valve the two commands at which its chambers begin to fill.",
      "Their middle is the centre, half of their distance the dead band. Restart the bench.",
    ],
    fields: [
      { name: "centre", label: "Centre, -1 to 1", triple: true },
      { name: "dead-band", label: "Dead band to either side", triple: true },
      { name: "uncertainty", label: "Standard uncertainty" },
    ],
  },
];

export async function loadValues() {
  const response = await fetch("/api/values", { cache: "no-store" }).catch(() => null);
  if (!response?.ok) return;
  content = await response.json();
  by("values-card").hidden = false;
  by("values").replaceChildren(inForce(), ...content.problems.map((text) => make("p", { class: "bad" }, `Arming blocked: ${text}`)), air());
  if (!by("forms").childElementCount) by("forms").replaceChildren(...FORMS.map(form));
}

const day = (text) => (text ? new Date(text).toLocaleDateString() : "");

function inForce() {
  const head = ["Calibration", "Values", "Entered", "Expires"].map((text) => make("th", { scope: "col", class: "left" }, text));
  const body = content.entries.map((one) => make("tr", {},
    make("td", {}, one.kind === "club" ? `club ${content.club}` : one.kind), make("td", { class: "left" }, one.words),
    make("td", { class: "left" }, one.version === null ? "" : `${day(one.date)} by ${one.by}, version ${one.version}`),
    make("td", { class: one.expired ? "left bad" : "left" }, one.expired ? `expired ${day(one.expires)}` : day(one.expires))));
  return make("div", { class: "scroll", tabindex: 0, role: "region", "aria-label": "Calibrations in force" }, make("table", {}, make("thead", {}, make("tr", {}, ...head)), make("tbody", {}, ...body)));
}

function air() {
  const one = content.air;
  return make("p", {}, one === null ? "No reading of the air yet." :
    `Air: ${one.temperature_c.toFixed(1)} °C, ${one.pressure_hpa.toFixed(1)} hPa, ${one.humidity_percent.toFixed(0)} %; read ${new Date(one.date).toLocaleString()} by ${one.by}.`);
}

function form(one) {
  const said = make("p", { class: "outcome", role: "status" });
  const id = (name, index = "") => `form-${one.name}-${name}${index}`;
  const labelled = (name, label, more) => make("label", {}, label, " ", make("input", { id: id(name), ...more }));
  const numbers = one.fields.map((field) => {
    const label = `${field.label}${field.unit ? `, ${field.unit}` : ""}${field.optional ? " (may be empty)" : ""}`;
    if (!field.triple) return make("label", {}, label, " ", make("input", { id: id(field.name), inputmode: "decimal", autocomplete: "off" }));
    return make("fieldset", {}, make("legend", {}, label), ...JOINTS.map((joint, index) =>
      make("label", {}, joint, " ", make("input", { id: id(field.name, index), inputmode: "decimal", autocomplete: "off", size: 8 }))));
  });
  if (one.club) numbers.unshift(make("label", {}, "Club ", make("select", { id: id("club") }, ...content.clubs.map((club) => make("option", { value: club, selected: club === content.club }, club)))));
  const lasting = one.lasting ? [labelled("method", "Method and tool", { maxlength: 200 }), labelled("days", "Days until it expires (may be empty)", { inputmode: "numeric" }), labelled("note", "Remark", { maxlength: 200 })] : [];
  const button = make("button", { type: "button", id: id("enter"), on: { click: () => enter(one, id, said, button) } }, "Enter");
  return make("details", {}, make("summary", {}, one.title), make("ol", { class: "steps" }, ...one.steps.map((text) => make("li", {}, text))),
    make("div", { class: "fields" }, ...numbers, ...lasting), make("div", { class: "row" }, button), said);
}

// A decimal comma is read as a point; anything else is left to the bench to refuse.
function read(id) {
  const text = by(id).value.trim().replace(",", ".");
  return text === "" ? null : Number(text);
}

async function enter(one, id, said, button) {
  const tell = (text, bad) => { set(said, text); said.classList.toggle("bad", bad); };
  if (!operator()) { by("holder").focus(); tell("Write your name first, at the top.", true); return; }
  if (!mayOperate()) { tell("Not possible now: you may not operate, or the page is not connected.", true); return; }
  const numbers = {}, body = { number: randomNumber(), by: operator(), numbers };
  for (const field of one.fields) {
    const values = field.triple ? JOINTS.map((_, index) => read(id(field.name, index))) : [read(id(field.name))];
    if (values.some(Number.isNaN) || (values.includes(null) && !(field.optional && values.every((v) => v === null)))) {
      by(id(field.name, field.triple ? 0 : "")).focus();
      tell(`${field.label}: a number${field.triple ? " for each joint" : ""}.`, true);
      return;
    }
    if (values[0] !== null) numbers[field.name] = field.triple ? values : values[0];
  }
  if (one.club) body.club = by(id("club")).value;
  if (one.lasting) {
    Object.assign(body, { method: by(id("method")).value, note: by(id("note")).value });
    const days = read(id("days"));
    if (days !== null) numbers["expires-days"] = days;
  }
  button.disabled = true;
  tell("Checking …", false);
  const answer = await send(`/api/values/${one.name}`, body, "", COMMAND_TIME);
  button.disabled = false;
  tell(say(answer, answer.note), !answer.ok);
  outcome(say(answer, answer.note), !answer.ok);
  if (answer.ok) loadValues();
}
