// A question before the robot moves; it closes by itself when its reason is gone.

import { by, set } from "./dom.js";

let stillHolds = () => true;

export function ask(title, text, yes, holds = () => true) {
  const dialog = by("ask");
  set("ask-title", title);
  set("ask-text", text);
  set("ask-yes", yes);
  stillHolds = holds;
  return new Promise((resolve) => {
    const done = (answer) => { by("ask-yes").onclick = by("ask-no").onclick = dialog.onclose = null; dialog.close(); resolve(answer); };
    by("ask-yes").onclick = () => done(true);
    by("ask-no").onclick = () => done(false);
    dialog.onclose = () => done(false);
    dialog.showModal();
    by("ask-no").focus();
  });
}

export function checkQuestion() {
  const dialog = by("ask");
  if (dialog.open && !stillHolds()) dialog.close();
}
