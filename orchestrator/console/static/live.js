// Live parts of a page, over one stream of server-sent events. A hidden page closes its stream, since a browser opens only six
// connections to a server, and continues after the last event that it has.
import { fill } from "./bind.js";

const AGAIN = 3000;
const PATIENCE = 5000;

/**
 * Follow a stream until it ends.
 * @param {string} address  of this server
 * @param {Object<string, function(any, string): void>} handlers  by name of event: called with its data and its id
 * @returns {{close: function(): void}}
 */
export function subscribe(address, handlers) {
  let source = null;
  let last = "";
  let hiding = 0;
  let isOver = false;

  function open() {
    if (isOver || source) return;
    const url = new URL(address, location.origin);
    if (last) url.searchParams.set("last", last);
    source = new EventSource(url);
    source.onopen = () => tell("");
    source.onerror = lost;
    for (const [name, handle] of Object.entries(handlers)) {
      source.addEventListener(name, (event) => {
        if (event.lastEventId) last = event.lastEventId;
        handle(JSON.parse(event.data), event.lastEventId);
      });
    }
    source.addEventListener("trouble", (event) => tell(JSON.parse(event.data)));
    source.addEventListener("end", close);
  }

  function pause() {
    source?.close();
    source = null;
  }

  function close() {
    isOver = true;
    pause();
    tell("");
  }

  function lost() {
    tell("connection lost; trying again");
    if (source?.readyState !== EventSource.CLOSED) return; // the browser itself tries again
    pause();
    setTimeout(returned, AGAIN);
  }

  async function returned() {
    try {
      const answer = await fetch(location.href, {
        method: "HEAD",
        redirect: "manual",
        headers: { Accept: "text/html" },
      });
      if (answer.type === "opaqueredirect") return location.reload(); // to the login
    } catch {
      // the server is still away
    }
    open();
  }

  document.addEventListener("visibilitychange", () => {
    clearTimeout(hiding);
    if (document.hidden) hiding = setTimeout(pause, PATIENCE);
    else open();
  });
  addEventListener("pagehide", pause);
  addEventListener("pageshow", (event) => event.persisted && open());
  open();
  return { close };
}

function tell(text) {
  const place = document.querySelector("[data-link]");
  if (!place) return;
  place.textContent = text;
  place.hidden = !text;
}

/** Start every table of the page that has `data-live`. */
export function startTables() {
  for (const region of document.querySelectorAll("[data-live]")) {
    subscribe(region.dataset.live, { rows: (data) => renew(region, data) });
  }
}

/** Renew a live table by an event of `orchestrator.console.live.Rows`. */
export function renew(region, data) {
  const body = region.querySelector("[data-rows]");
  const blank = region.querySelector("[data-blank]");
  const known = new Map([...body.children].map((row) => [row.dataset.key, row]));
  for (const [key, fields] of Object.entries(data.rows ?? {})) {
    let row = known.get(key);
    if (!row) {
      row = blank.content.firstElementChild.cloneNode(true);
      row.dataset.key = key;
      known.set(key, row);
    }
    fill(row, fields);
  }
  if (data.order) arrange(body, data.order.map((key) => known.get(key)).filter(Boolean));
  if (data.totals) for (const place of document.querySelectorAll("[data-total]")) fill(place, data.totals);
  const empty = region.querySelector("[data-empty]");
  if (empty) empty.hidden = body.childElementCount > 0;
  region.dispatchEvent(new CustomEvent("renewed"));
}

/** The rows in this order; one that is in its place is not touched, and keeps the focus. */
function arrange(body, rows) {
  const wanted = new Set(rows);
  for (const row of [...body.children]) if (!wanted.has(row)) row.remove();
  rows.forEach((row, index) => {
    if (body.children[index] !== row) body.insertBefore(row, body.children[index] ?? null);
  });
}
