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
 * @returns {Promise<object|null>} the response; null if the person cancelled, or the server refused (which is shown)
 */
async function send(address, fields) {
  const body = new URLSearchParams(fields);
  if (!body.has("form_token")) body.set("form_token", document.querySelector("meta[name=form-token]").content);
  let response;
  try {
    response = await fetch(address, { method: "POST", body, headers: { Accept: "application/json" } });
  } catch {
    show("the server can't be reached; try again", true);
    return null;
  }
  const status = `${response.status} ${response.statusText}`;
  const data = await response.json().catch(() => ({ message: status }));
  if (data.question) {
    if (!(await ask(data.question))) return null;
    body.set("confirmed", "yes");
    return send(address, body);
  }
  if (response.ok) return data;
  show(data.message ?? status, true);
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
    const response = await send(button?.getAttribute("formaction") ?? form.getAttribute("action"), fields);
    if (button) button.disabled = false;
    if (response) follow(response, form);
    else if (form.matches("[data-fields]")) blame(form);
  });
  for (const box of document.querySelectorAll("[data-mark-all]")) {
    box.addEventListener("change", () => markAll(box.checked));
  }
}

/** The refusal stands at the field that its first word names, until something in the form is changed. */
function blame(form) {
  const message = document.querySelector("[data-message]").textContent;
  const field = form.elements.namedItem(message.split(/[: ]/, 1)[0]);
  if (!field?.setCustomValidity) return;
  field.setCustomValidity(message);
  field.reportValidity();
  form.addEventListener("input", () => field.setCustomValidity(""), { once: true });
}

function follow({ location: address, message = "" }, form) {
  if (address && address !== location.pathname + location.search) {
    if (message) sessionStorage.setItem(KEPT, message);
    location.assign(address);
    return;
  }
  show(message);
  if (form.matches("[data-bulk]")) markAll(false);
}

function markAll(isMarked) {
  for (const box of document.querySelectorAll("[data-rows] input[type=checkbox]")) box.checked = isMarked;
  for (const box of document.querySelectorAll("[data-mark-all]")) box.checked = isMarked;
}
