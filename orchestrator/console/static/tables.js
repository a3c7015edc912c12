// A page with several live tables over one stream: each region's data-table is the name of its events.
import { renew, subscribe } from "./live.js";

const handlers = {};
for (const region of document.querySelectorAll("[data-table]")) {
  handlers[region.dataset.table] = (data) => renew(region, data);
}
subscribe(document.querySelector("[data-tables]").dataset.tables, handlers);
