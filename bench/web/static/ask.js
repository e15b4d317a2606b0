// A question before the robot moves; it closes automatically when its reason is gone.
// It is not modal: a modal one would make the stop behind it unreachable.

import { by, set } from "./dom.js";

let stillHolds = () => true;
let finish = null;

export function ask(title, text, yes, holds = () => true) {
  finish?.(false);
  set("ask-title", title);
  set("ask-text", text);
  set("ask-yes", yes);
  stillHolds = holds;
  const before = document.activeElement;
  return new Promise((resolve) => {
    finish = (answer) => {
      finish = null;
      by("ask").close();
      by("veil").hidden = true;
      before?.focus?.();
      resolve(answer);
    };
    by("veil").hidden = false;
    by("ask").show();
    by("ask-no").focus();
  });
}

export function startQuestions() {
  by("ask-yes").addEventListener("click", () => finish?.(true));
  by("ask-no").addEventListener("click", () => finish?.(false));
  by("veil").addEventListener("click", () => finish?.(false));
  document.addEventListener("keydown", (event) => { if (event.key === "Escape") finish?.(false); });
}

export function checkQuestion() {
  if (finish !== null && !stillHolds()) finish(false);
}
