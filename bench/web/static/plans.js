// Campaigns from a plan: check it, look at its preview, start it. The runner is a separate process.

import { ask } from "./ask.js";
import { by, make, pair, set } from "./dom.js";
import { startNewPlan } from "./newplan.js";
import { mayOperate, operator, outcome, randomNumber, releaseLease } from "./operate.js";
import { COMMAND_TIME, say, send } from "./send.js";
import { duration } from "./state.js";
import { unitSystem } from "./units.js";

const SHOWN = 6;
let plans = [];
let preview = null;
let runner = null;
let bench = { seen: 0, series: false };
let busy = false;
let whole = false;
let running = false;

export const setPlansBench = (view) => {
  const changed = bench.series !== view.series;
  bench = view;
  if (changed && preview !== null) show(preview);
};

export async function loadPlans() {
  const response = await fetch("/api/plans", { cache: "no-store" }).catch(() => null);
  if (!response?.ok) return;
  plans = await response.json();
  const chosen = by("plan").value;
  by("plan").replaceChildren(...plans.map((one) => make("option", { value: one.name }, `${one.title} (${one.name}${one.shipped ? "" : ", of this bench"}${one.lacks.length ? ", not with this configuration" : ""})`)));
  if (plans.some((one) => one.name === chosen)) by("plan").value = chosen;
  by("plans-card").hidden = running || plans.length === 0;
  choose();
}

export function startPlans() {
  by("plan").addEventListener("change", choose);
  by("plan-check").addEventListener("click", check);
  by("plan-start").addEventListener("click", start);
  startNewPlan(loadPlans);
  setInterval(refresh, 300);
}

// While a campaign runs, no other can be started: its card makes room.
export function showPlansBeside(campaigns) {
  running = campaigns.length > 0;
  by("plans-card").hidden = running || plans.length === 0;
}

export function showRunner(content) {
  runner = content;
  refresh();
}

function choose() {
  const plan = plans.find((one) => one.name === by("plan").value);
  const lacks = plan?.lacks.length ? `The configuration of this bench lacks ${plan.lacks.join(", ")}.` : "";
  set("plan-about", [lacks, plan?.about].filter(Boolean).join(" "));
  if (preview?.plan !== by("plan").value) show(null);
}

function refresh() {
  const may = mayOperate() && !busy;
  by("plan-check").disabled = !may;
  by("plan-start").disabled = !(may && preview !== null && !runner?.running);
  by("runner").classList.toggle("bad", Boolean(runner?.text));
  set("runner", runner === null ? "" : runner.running
    ? `Runner of ${runner.what}: running. It continues without this page.`
    : runner.text ? `Runner of ${runner.what} has ended. ${runner.text}` : `Runner of ${runner.what} has ended: done. Figures and report: Campaigns and records, below.`);
}

async function check() {
  const name = by("plan").value;
  busy = true;
  refresh();
  set("plan-said", "Checking …");
  by("plan-said").classList.remove("bad");
  const answer = await send(`/api/plan/${encodeURIComponent(name)}/check`, {}, "", COMMAND_TIME);
  busy = false;
  by("plan-said").classList.toggle("bad", !answer.ok);
  set("plan-said", answer.ok ? "" : say(answer, ""));
  whole = false;
  show(answer.ok && by("plan").value === name ? answer : null);
}

function show(found) {
  preview = found;
  by("plan-preview").replaceChildren(...(found === null ? [] : parts(found)));
  refresh();
}

function parts(found) {
  const work = found.hand_work;
  const more = () => { whole = true; show(preview); };
  const cut = (list) => (whole ? list : list.slice(0, SHOWN));
  // The command knows the configuration; this bench may have been started with --series.
  const warnings = found.warnings.filter((text) => !(bench.series && text === found.series_warning));
  const rest = (list) => (whole || list.length <= SHOWN ? "" : make("button", { type: "button", on: { click: more } }, `Show ${list.length - SHOWN} more`));
  return [
    make("dl", { class: "big" }, ...[
      ["Shots", String(found.shots)],
      ["Warm-up", found.warm_up_at_most ? `up to ${found.warm_up_at_most}` : "none"],
      ["Time", duration(found.expected_duration_s + found.needs.hand_work)],
      ["Club changes", String(found.needs.club_changes)],
      ["Feeder fills", String(found.needs.feeder_fills)],
    ].map(pair)),
    make("ul", { class: "words" }, ...[...warnings.map((text) => make("li", { class: "warn" }, `Attention: ${text}`)),
      ...[...found.outlook_words, ...found.needs_words].map((text) => make("li", {}, text))]),
    make("h3", {}, "Hits of each ball"),
    make("p", {}, Object.entries(found.hits).map(([name, number]) => `${name}: ${number}`).join(", ")),
    make("h3", {}, `Order of the shots, from seed ${found.seed}`),
    make("ol", { class: "order" }, ...cut(found.order).map((block) => make("li", {}, make("span", { class: "muted" }, `Block ${block.block} `), order(block, found.order)))),
    rest(found.order),
    make("h3", {}, "Work by hand"),
    work.length
      ? make("ol", { class: "order" }, ...cut(work).map((one) => make("li", {}, make("span", { class: "muted" }, `before shot ${one.shot} `), one.text)))
      : make("p", {}, "None is planned."),
    rest(work),
  ];
}

// Swing, club and ball that differ in the block name its shots; those that differ only between blocks come first.
function order(block, blocks) {
  const differs = (shots, at) => new Set(shots.map((shot) => shot[at])).size > 1;
  const parts = [1, 2, 3].filter((at) => differs(blocks.flatMap((one) => one.shots), at));
  const own = parts.filter((at) => differs(block.shots, at));
  const before = parts.filter((at) => !own.includes(at)).map((at) => block.shots[0][at]);
  const named = own.length ? own : [3];
  const shots = block.shots.map((shot) => `${named.map((at) => shot[at]).join(" / ")}${shot[0] === "control" ? " (control)" : ""}`);
  return `${before.length ? `${before.join(", ")}: ` : ""}${shots.join(" · ")}`;
}

async function start() {
  if (!operator()) { by("holder").focus(); outcome("Write your name first.", true); return; }
  const { plan, digest, title, shots } = preview;
  const text = `${title || plan}: ${shots} shots. The runner takes the lease (one of this page is released, which disarms), locks the guard, warns, arms and swings automatically; it also resets and homes a simulated bench. Is everybody outside the guard, and the range clear?`;
  const possible = () => mayOperate() && preview?.digest === digest;
  if (!(await ask("Start the campaign?", text, "Start", possible))) return;
  if (!possible()) return;
  if (!(await releaseLease())) return;
  const body = { number: randomNumber(), seen: bench.seen, by: operator(), digest, units: unitSystem(), ask: by("plan-ask").checked };
  const answer = await send(`/api/plan/${encodeURIComponent(plan)}/start`, body);
  outcome(answer.ok ? "" : say(answer, ""), !answer.ok); // the plan's card shows its runner, another card its campaign
  if (answer.ok) show(null);
}
