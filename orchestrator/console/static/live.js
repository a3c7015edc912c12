// Live parts of a page, over one stream of server-sent events. A hidden page closes its stream, since a browser opens only six
// connections to a server, and continues after the last event that it has.
import { renewTimes } from "./times.js";

const AGAIN = 3000;
const PATIENCE = 5000;
const FRAGMENTS = globalThis.trustedTypes?.createPolicy("fragments", { createHTML: (text) => text });

/**
 * Follow a stream until it ends. Its event `parts` renews parts of the page.
 * @param {string} address  of this server
 * @param {Object<string, function(any): void>} handlers  by name of other events: called with their data
 * @returns {{close: function(): void}}
 */
export function subscribe(address, handlers = {}) {
  let source = null;
  let last = "";
  let hiding = 0;
  let isOver = false;

  function open() {
    if (isOver || source) return;
    const url = new URL(address, location.origin);
    if (last) url.searchParams.set("last", last);
    source = new EventSource(url);
    source.onopen = () => report("");
    source.onerror = lost;
    for (const [name, handle] of Object.entries({ parts: renew, trouble: report, ...handlers, end: close })) {
      source.addEventListener(name, (event) => {
        if (event.lastEventId) last = event.lastEventId;
        handle(JSON.parse(event.data));
      });
    }
  }

  function pause() {
    source?.close();
    source = null;
  }

  function close() {
    isOver = true;
    pause();
    report("");
  }

  function lost() {
    report("connection lost; trying again");
    if (source?.readyState !== EventSource.CLOSED) return; // the browser itself tries again
    pause();
    setTimeout(returned, AGAIN);
  }

  async function returned() {
    try {
      const response = await fetch(location.href, { method: "HEAD", redirect: "manual", headers: { Accept: "text/html" } });
      if (response.type === "opaqueredirect") return location.reload(); // to the login
    } catch {
      // the server is still unavailable
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

function report(text) {
  const place = document.querySelector("[data-link]");
  place.textContent = text;
  place.hidden = !text;
}

/** Start the live parts of a page that has no script of its own for them. */
export function startLive() {
  const place = document.querySelector("[data-live]");
  if (place) subscribe(place.dataset.live);
}

/** Renew parts of the page by an event of `orchestrator.console.live.LiveParts`. */
function renew(parts) {
  for (const [id, part] of Object.entries(parts)) {
    const place = document.getElementById(id);
    if (id === "page" && part !== document.querySelector("[data-page]").dataset.page) location.reload();
    else if (!place) continue;
    else if (typeof part === "string") patchChildren(place, fragment(part));
    else renewTable(place, part);
  }
  renewTimes();
}

function renewTable(place, { order, rows }) {
  const body = place.querySelector("[data-rows]");
  const known = new Map([...body.children].map((row) => [row.dataset.key, row]));
  for (const [key, markup] of Object.entries(rows)) {
    const fresh = fragment(markup).firstElementChild;
    if (known.has(key)) patch(known.get(key), fresh);
    else known.set(key, fresh);
  }
  if (!order) return;
  const keys = new Set(order);
  for (const [key, row] of known) if (!keys.has(key)) row.remove();
  order.forEach((key, index) => {
    // a row that is in its place is not touched, and keeps the focus
    if (body.children[index] !== known.get(key)) body.insertBefore(known.get(key), body.children[index] ?? null);
  });
  place.querySelector("[data-empty]").hidden = order.length > 0;
}

/** Markup that the server rendered. */
function fragment(markup) {
  const template = document.createElement("template");
  template.innerHTML = FRAGMENTS?.createHTML(markup) ?? markup;
  return template.content;
}

/** Make an element like a fresh one. What both have stays, and with it the focus, marks and typed texts. */
function patch(old, fresh) {
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name)) old.removeAttribute(name);
  for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  patchChildren(old, fresh);
}

function patchChildren(old, fresh) {
  if (old.dataset?.since !== undefined) return; // times.js writes it
  const [before, after] = [[...old.childNodes], [...fresh.childNodes]];
  after.forEach((node, index) => {
    const same = before[index];
    if (!same) old.append(node);
    else if (same.nodeName !== node.nodeName) same.replaceWith(node);
    else if (node instanceof Element) patch(same, node);
    else if (same.data !== node.data) same.data = node.data;
  });
  for (const each of before.slice(after.length)) each.remove();
}
