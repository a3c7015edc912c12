// The page of a job: its facts, curves, log, attempts and checkpoints, over one stream.
import { fill } from "./bind.js";
import { JobCurves } from "./job_curves.js";
import { JobLog } from "./log.js";
import { renew, subscribe } from "./live.js";

const page = document.querySelector("[data-job]");
const address = page.dataset.job;
const curves = page.dataset.curves && page.querySelector("[data-charts]") ? new JobCurves(page, page.dataset.curves) : null;
const log = page.querySelector("[data-log]") ? new JobLog(page, address) : null;
let stream = null;

/** Follow the job; the page's positions in its log and its curves are the place where the stream continues. */
function follow() {
  stream?.close();
  const url = new URL(`${address}/stream`, location.origin);
  for (const [name, value] of Object.entries(log?.filter ?? {})) if (value) url.searchParams.set(name, value);
  url.searchParams.set("last", JSON.stringify({ i: curves?.last ?? null, l: log?.last ?? {} }));
  stream = subscribe(url.pathname + url.search, {
    facts: (data) => {
      if (data.run && !page.dataset.curves) location.reload(); // it has started: now there is more to see
      const view = page.querySelector("[data-view]");
      if (view && "view" in data && data.view !== view.dataset.view) location.reload(); // a frame needs a policy of its own
      page.querySelectorAll("[data-facts]").forEach((place) => fill(place, data));
    },
    attempts: (data) => renewed("[data-attempts]", data),
    checkpoints: (data) => renewed("[data-checkpoints]", data),
    metrics: (data) => curves?.add(data),
    lines: (data) => log?.add(data),
    window: (data) => log?.replace(data),
  });
}

function renewed(selector, data) {
  const place = page.querySelector(selector);
  if (place) renew(place, data);
}

await Promise.all([curves?.load(), log?.load()]);
log?.onFilter(follow);
follow();
