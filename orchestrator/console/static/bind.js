// Puts texts of the server where the templates' bound(...) said. Nothing here ever becomes markup.
const ATTRIBUTES = new Set(["href", "title", "value", "max", "points", "datetime", "aria-label", "min", "label", "x", "width"]);

/** Renew every bound part of `root` whose field is in `record`. */
export function fill(root, record) {
  if (root.dataset.bind) put(root, record);
  for (const element of root.querySelectorAll("[data-bind]")) put(element, record);
}

function put(element, record) {
  for (const pair of element.dataset.bind.split(" ")) {
    const [target, field] = pair.split(":");
    if (!Object.hasOwn(record, field)) continue;
    const value = record[field] ?? "";
    if (target === "text") element.textContent = value;
    else if (target === "hidden") hide(element, !value);
    else if (target === "state") element.dataset.state = value;
    else if (target === "href") element.setAttribute("href", String(value).startsWith("/") ? value : "/");
    else if (ATTRIBUTES.has(target)) element.setAttribute(target, value);
  }
}

function hide(element, isHidden) {
  element.hidden = isHidden;
  if (isHidden && "checked" in element) element.checked = false;
}
