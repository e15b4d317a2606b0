// Rerun's viewer: a link that starts it, for a browser on the page's own computer, and a button that ends it.

import { by } from "./dom.js";
import { outcome } from "./operate.js";
import { say, send } from "./send.js";

const HERE = ["127.0.0.1", "localhost", "[::1]"];

export function startViewer() {
  by("viewer").hidden = !HERE.includes(location.hostname);
  by("viewer").querySelector("a").addEventListener("click", () => outcome("The 3D view opens in a new tab; the first start takes up to a minute.", false));
  by("viewer-close").addEventListener("click", async () => {
    const answer = await send("/api/viewer/close");
    outcome(say(answer, "The 3D view is closed."), !answer.ok);
  });
}

export function showViewer(content) {
  by("viewer-close").hidden = !content.open;
}
