import { loadArchive } from "./archive.js";
import { onEnd, setSeen, showCampaigns } from "./campaign.js";
import { by } from "./dom.js";
import { loadValues, showAccess } from "./forms.js";
import { keep, startTheme } from "./keep.js";
import { showLease, showYou, startOperate } from "./operate.js";
import { loadPlans, setPlansSeen, showPlansBeside, showRunner, startPlans } from "./plans.js";
import { showEvents, showState } from "./state.js";
import { on, startStream } from "./stream.js";
import { showSwing } from "./swing.js";
import { showViewer, startViewer } from "./viewer.js";
import { startUnits } from "./units.js";

startTheme(by("theme"));
startUnits(by("units"), keep);
on("you", (you) => { showYou(you); loadArchive(); loadPlans(); loadValues(); });
on("state", (view) => { setSeen(view.seen); setPlansSeen(view.seen); showState(view); showLease(view); showAccess(view); });
on("events", showEvents);
on("swing", (view) => { showSwing(view); if (view.stored) loadArchive(); });
on("campaigns", (content) => { showCampaigns(content); showPlansBeside(content); });
on("runner", (content) => { showRunner(content); if (!content.running) loadArchive(); });
on("viewer", showViewer);
onEnd(loadArchive);
startPlans();
startViewer();
startOperate(startStream(["link", "you", "state", "events", "swing", "campaigns", "runner", "viewer"]));
const askRole = () => fetch("/api/you").then((response) => response.json()).then(showYou).catch(() => {});
on("refused", askRole); // a page that was started again has forgotten its sessions
askRole();
