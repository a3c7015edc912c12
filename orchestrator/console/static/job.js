// The page of a job or of a run: its curves and its log, where it has them, over the stream of its live parts.
import { RunCurves } from "./curves.js";
import { JobLog } from "./log.js";
import { subscribe } from "./live.js";

const page = document.querySelector("[data-stream]");
const address = page.dataset.stream;
const place = page.querySelector("[data-curves]");
const curves = place ? new RunCurves(place) : null;
const log = page.querySelector("[data-log]") ? new JobLog(page, address) : null;
let stream = null;

/** Follow the page's stream from its positions in the log and in the curves. */
function follow() {
  stream?.close();
  const url = new URL(`${address}/stream`, location.origin);
  for (const [name, value] of Object.entries(log?.filter ?? {})) if (value) url.searchParams.set(name, value);
  url.searchParams.set("last", JSON.stringify({ i: curves?.last ?? null, l: log?.last ?? {} }));
  stream = subscribe(url.pathname + url.search, {
    metrics: (data) => curves?.add(data),
    lines: (data) => log?.add(data),
    window: (data) => log?.replace(data),
  });
}

await Promise.all([curves?.load(), log?.load()]);
log?.onFilter(follow);
follow();
