// What every page has: live parts, times, forms, the theme.
import { startForms, showKept } from "./forms.js";
import { startLive } from "./live.js";
import { startTheme } from "./theme.js";
import { startTimes } from "./times.js";

startTheme();
startTimes();
startForms();
showKept();
startLive();
