// Forms with data-send: the server's question is a dialog, its answer a message, and the page stays where it is.
const KEPT = "muster-message";

/** A message to the person, also to one who hears the page. */
export function show(text, isProblem = false) {
  const place = document.querySelector("[data-message]");
  place.textContent = text;
  place.classList.toggle("problem", isProblem);
  place.hidden = !text;
}

/** The message that the page before this one left. */
export function showKept() {
  const kept = sessionStorage.getItem(KEPT);
  sessionStorage.removeItem(KEPT);
  if (kept) show(kept);
}

/**
 * Send fields to an address of this server; a question is asked first.
 * @returns {Promise<object|null>} the answer; null where the person said no, or the server refused (which is shown)
 */
export async function send(address, fields) {
  const body = new URLSearchParams(fields);
  if (!body.has("form_token")) body.set("form_token", document.querySelector("meta[name=form-token]").content);
  let answer;
  try {
    answer = await fetch(address, { method: "POST", body, headers: { Accept: "application/json" } });
  } catch {
    show("the server can't be reached; try again", true);
    return null;
  }
  const told = await answer.json().catch(() => ({ message: `${answer.status} ${answer.statusText}` }));
  if (told.question) {
    if (!(await ask(told.question))) return null;
    body.set("confirmed", "yes");
    return send(address, body);
  }
  if (answer.ok) return told;
  show(told.message ?? `${answer.status} ${answer.statusText}`, true);
  return null;
}

function ask(question) {
  const dialog = document.querySelector("dialog[data-question]");
  dialog.querySelector("h2").textContent = question.title;
  dialog.querySelector("p").textContent = question.text;
  dialog.querySelector("button.danger").textContent = question.label;
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => {
    dialog.addEventListener("close", () => resolve(dialog.returnValue === "yes"), { once: true });
  });
}

export function startForms() {
  document.addEventListener("submit", async (event) => {
    const form = event.target;
    if (!form.matches("form[data-send]")) return;
    event.preventDefault();
    const button = event.submitter;
    const fields = new FormData(form, button);
    if (button) button.disabled = true; // a second click sends nothing twice
    const told = await send(button?.getAttribute("formaction") ?? form.getAttribute("action"), fields);
    if (button) button.disabled = false;
    if (told) follow(told, form);
    else if (form.matches("[data-fields]")) blame(form);
  });
  for (const box of document.querySelectorAll("[data-mark-all]")) {
    box.addEventListener("change", () => markAll(box.checked));
  }
}

/** The refusal stands at the field that its first word names, until something in the form is changed. */
function blame(form) {
  const told = document.querySelector("[data-message]").textContent;
  const field = form.elements.namedItem(told.split(/[: ]/, 1)[0]);
  if (!field?.setCustomValidity) return;
  field.setCustomValidity(told);
  field.reportValidity();
  form.addEventListener("input", () => field.setCustomValidity(""), { once: true });
}

function follow(told, form) {
  const here = location.pathname + location.search;
  if (told.location && told.location !== here) {
    if (told.message) sessionStorage.setItem(KEPT, told.message);
    location.assign(told.location);
    return;
  }
  show(told.message ?? "");
  if (form.matches("[data-bulk]")) markAll(false);
}

function markAll(isMarked) {
  for (const box of document.querySelectorAll("[data-rows] input[type=checkbox]")) box.checked = isMarked && !box.hidden;
  for (const box of document.querySelectorAll("[data-mark-all]")) box.checked = isMarked;
}
