// A page with several live tables over one stream: each region's data-table is the name of its events. The event `changed`, of pages
// that have more than tables, becomes one of the document.
import { renew, subscribe } from "./live.js";

const handlers = { changed: (detail) => document.dispatchEvent(new CustomEvent("changed", { detail })) };
for (const region of document.querySelectorAll("[data-table]")) {
  handlers[region.dataset.table] = (data) => renew(region, data);
}
subscribe(document.querySelector("[data-tables]").dataset.tables, handlers);
