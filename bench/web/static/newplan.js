// A new plan by a form: duration and resolution first, then a file of this bench.

import { by, make } from "./dom.js";
import { randomNumber } from "./operate.js";
import { COMMAND_TIME, say, send } from "./send.js";


export function startNewPlan(saved) {
  const form = by("new-plan").querySelector("form");
  by("new-plan").addEventListener("toggle", () => fill(form), { once: true });
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    write(form, event.submitter, saved);
  });
}

async function fill(form) {
  const response = await fetch("/api/names", { cache: "no-store" }).catch(() => null);
  if (!response?.ok) return;
  for (const [section, names] of Object.entries(await response.json())) {
    form.elements[section].replaceChildren(...names.map((name) => make("option", { value: name }, name)));
  }
}

async function write(form, button, saved) {
  const chosen = (name) => [...form.elements[name].selectedOptions].map((one) => one.value);
  const said = by("new-plan-said");
  button.disabled = true;
  said.replaceChildren(make("li", {}, "Being made …"));
  const body = {
    number: randomNumber(), save: button.value === "save",
    name: form.elements.name.value, compare: form.elements.compare.value,
    balls: chosen("balls"), clubs: chosen("clubs"), swings: chosen("swings"),
    difference: form.elements.difference.valueAsNumber, sd: form.elements.sd.valueAsNumber,
  };
  const answer = await send("/api/new-plan", body, "", COMMAND_TIME);
  button.disabled = false;
  const words = answer.ok ? [...answer.words, ...(answer.saved ? ["Saved: choose it above."] : [])] : [say(answer, "")];
  said.replaceChildren(...words.map((text) => make("li", { class: answer.ok ? "" : "warn" }, text)));
  if (answer.ok && answer.saved) saved();
}
