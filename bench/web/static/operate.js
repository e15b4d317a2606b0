// Stop, lease and commands.

import { ask, checkQuestion, startQuestions } from "./ask.js";
import { by, make, set } from "./dom.js";
import { keep } from "./keep.js";
import { say, send } from "./send.js";
import { isLive } from "./stream.js";

const COMMANDS = [
  ["reset", "Reset", "", "Reset: the cause is cleared. The robot does not move."],
  ["home", "Home", "The robot moves slowly to find its zeros. Is everybody outside the guard?", "Home the robot?"],
  ["arm", "Arm", "The guard locks, the beacon warns, air comes on, and the robot goes to its address. Is everybody outside the guard?", "Arm the robot?"],
  ["tee", "Tee", "The tee raises the next ball.", "Raise a ball?"],
  ["swing", "Swing", "The robot swings at full speed. Is everybody outside the guard, and the range clear?", "Swing now?"],
  ["disarm", "Disarm", "", ""],
  ["access", "Open access", "The guard unlocks, to change club or ball.", "Open the access?"],
  ["secure", "End access", "The guard locks. Is everybody outside?", "End the access?"],
];
const RENEW = 3000; // ms
const STOP_TIME = 3000; // ms until a stop without an answer is said to have failed
let state = null;
let you = { role: null };
let ticket = "";
let busy = false;
let again = () => {};

export function startOperate(reconnect) {
  again = reconnect;
  startQuestions();
  by("stop").addEventListener("click", () => stop("stop", "Stop"));
  by("estop").addEventListener("click", () => stop("estop", "Stop and latch"));
  by("take").addEventListener("click", take);
  by("release").addEventListener("click", release);
  by("sign-in-button").addEventListener("click", signIn);
  by("token").addEventListener("keydown", (event) => { if (event.key === "Enter") signIn(); });
  by("holder").value = keep.get("holder", "");
  by("holder").addEventListener("change", () => keep.put("holder", by("holder").value));
  by("commands").append(...COMMANDS.map(([name, label, text, title]) =>
    make("button", { type: "button", id: `do-${name}`, disabled: true, on: { click: () => command(name, label, text, title) } }, label)));
  setInterval(renew, RENEW);
  setInterval(refresh, 300);
}

export function showYou(content) {
  you = content;
  by("sign-in").hidden = !(you.role === null && you.sign_in);
  const words = {
    operator: "", viewer: "You are a viewer: you may look, and stop.",
    stopper: "Your certificate has no role: you may only stop.",
  };
  set("role", you.role === null ? "Not signed in." : words[you.role] ?? "");
  refresh();
}

export function showLease(view) {
  state = view;
  const lease = view.lease;
  const mine = ticket && lease ? " (this page)" : "";
  set("lease", lease ? `Lease: ${lease.holder}${mine}, ${Math.ceil(lease.seconds_left)} s left` : "Lease: not held");
  checkQuestion();
  refresh();
}

export const isOperator = () => you.role === "operator";
export const mayOperate = () => isOperator() && isLive();
export const operator = () => by("holder").value.trim();

function refresh() {
  const may = mayOperate() && !busy && state !== null;
  for (const [name] of COMMANDS) {
    const free = name === "disarm" || ticket !== "";
    by(`do-${name}`).disabled = !(may && free && state.accepts.includes(name));
  }
  by("take").hidden = by("holder-label").hidden = ticket !== "";
  by("take").disabled = !mayOperate() || state === null || state.lease !== null;
  by("release").hidden = ticket === "";
}

// The same as a click on the command's own button, with its question.
export function press(name) {
  if (!by(`do-${name}`).disabled) return by(`do-${name}`).click();
  outcome(ticket === "" && name !== "disarm" ? "Take the lease first." : "Not possible in this state.", true);
}

export function outcome(text, bad) {
  set("outcome", text);
  by("outcome").classList.toggle("bad", bad);
}

async function stop(name, label) {
  outcome(`${label}: sent …`, false);
  const answer = await send(`/api/stop/${name}`, {}, "", STOP_TIME);
  outcome(answer.ok ? `${label}: the bench has taken it.` : `${label} FAILED. Use the emergency stop. ${say(answer, "")}`, !answer.ok);
}

async function command(name, label, text, title) {
  const possible = () => mayOperate() && state.accepts.includes(name) && (name === "disarm" || ticket !== "");
  if (text && !(await ask(title, text, label, possible))) return;
  if (!possible()) return outcome(`${label}: not sent, the bench has changed.`, true);
  busy = true;
  refresh();
  outcome(`${label}: sent …`, false);
  const answer = await send(`/api/command/${name}`, { number: randomNumber(), seen: state.seen }, ticket);
  busy = false;
  outcome(answer.ok ? [`${label}: accepted.`, answer.note].filter(Boolean).join(" ") : `${label}: ${say(answer, "")}`, !answer.ok);
  refresh();
}

async function take() {
  if (!operator()) { by("holder").focus(); return outcome("Write your name, then take the lease.", true); }
  const answer = await send("/api/lease", { action: "take", holder: operator() });
  if (answer.ok) ticket = answer.ticket;
  outcome(say(answer, "The lease is yours while this page is open."), !answer.ok);
  refresh();
}

async function renew() {
  if (!ticket) return;
  const mine = ticket;
  const answer = await send("/api/lease", { action: "renew" }, mine);
  if (answer.status === 409 && ticket === mine) {
    ticket = "";
    outcome("The lease is lost: take it again. An armed bench disarms.", true);
    refresh();
  }
}

async function release() {
  const mine = ticket;
  ticket = "";
  const answer = await send("/api/lease", { action: "release" }, mine);
  outcome(say(answer, "The lease is released."), !answer.ok);
  refresh();
  return answer.ok;
}

// A runner takes the lease itself: one of this page stands in its way.
export const releaseLease = async () => ticket === "" || release();

async function signIn() {
  const answer = await send("/api/sign-in", { token: by("token").value });
  by("token").value = "";
  outcome(say(answer, "Signed in."), !answer.ok);
  if (answer.ok) again();
}

export const randomNumber = () => Array.from(crypto.getRandomValues(new Uint32Array(4)), (part) => part.toString(36)).join("-");
