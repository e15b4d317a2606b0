import { by } from "./dom.js";
import { keep, startTheme } from "./keep.js";
import { showLease, showYou, startOperate } from "./operate.js";
import { showEvents, showState } from "./state.js";
import { on, startStream } from "./stream.js";
import { startUnits } from "./units.js";

startTheme(by("theme"));
startUnits(by("units"), keep);
on("you", showYou);
on("state", (view) => { showState(view); showLease(view); });
on("events", showEvents);
startOperate(startStream(["link", "you", "state", "events"]));
fetch("/api/you").then((response) => response.json()).then(showYou).catch(() => {});
