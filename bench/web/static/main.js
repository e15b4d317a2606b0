import { loadArchive } from "./archive.js";
import { onEnd, setSeen, showCampaigns } from "./campaign.js";
import { showCommissioner, showCommissioning, startCommissioning } from "./commission.js";
import { by } from "./dom.js";
import { loadValues, showAccess } from "./forms.js";
import { keep, startTheme } from "./keep.js";
import { showLease, showYou, startOperate } from "./operate.js";
import { loadPlans, setPlansBench, showPlansBeside, showRunner, startPlans } from "./plans.js";
import { showEvents, showState } from "./state.js";
import { on, startStream } from "./stream.js";
import { showSwing } from "./swing.js";
import { showViewer, startViewer } from "./viewer.js";
import { startUnits } from "./units.js";

startTheme(by("theme"));
startUnits(by("units"), keep);
let signed = 0;
on("you", (you) => { signed += 1; showYou(you); loadArchive(); loadPlans(); loadValues(); });
on("state", (view) => { setSeen(view.seen); setPlansBench(view); showState(view); showLease(view); showAccess(view); });
on("events", showEvents);
on("swing", (view) => { showSwing(view); if (view.stored) loadArchive(); });
on("campaigns", (content) => { showCampaigns(content); showPlansBeside(content); });
on("runner", (content) => { showRunner(content); if (!content.running) loadArchive(); });
on("viewer", showViewer);
on("commissioning", showCommissioning);
on("commissioner", showCommissioner);
onEnd(loadArchive);
startPlans();
startViewer();
startCommissioning();
startOperate(startStream(["link", "you", "state", "events", "swing", "campaigns", "runner", "viewer", "commissioning", "commissioner"]));
// An answer from before a sign-in may arrive after it: the stream's word is newer.
async function askRole() {
  const before = signed;
  const you = await fetch("/api/you").then((response) => response.json()).catch(() => null);
  if (you !== null && before === signed) showYou(you);
}
on("refused", askRole); // a page that was started again has forgotten its sessions
askRole();
