// The log of a job: a window of it, never the whole. At its end the stream adds lines; earlier ones are read as the person asks.
import { show } from "./forms.js";

const MOST = 2500;
const NEAR = 40;
const SEARCHED = 64;
const ERROR = /Traceback \(most recent call last\)|\b[A-Za-z]*(?:Error|Exception): |\b(?:ERROR|FATAL|CRITICAL)\b/;
const COLOURS = /\u001b\[[0-9;]*m/g;
const CONTROL = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u200e\u200f\u202a-\u202e\u2066-\u2069]/g;

export class JobLog {
  /** @param {HTMLElement} page  @param {string} address  of the job */
  constructor(page, address) {
    this.address = `${address}/log`;
    this.place = page.querySelector("[data-log]");
    this.form = page.querySelector("[data-log-filter]");
    this.state = page.querySelector("[data-log-state]");
    this.found = page.querySelector("[data-found]");
    this.buttons = Object.fromEntries(["earlier", "later", "follow"].map((each) => [each, page.querySelector(`[data-${each}]`)]));
    this.filter = {};
    this.first = this.last = {};
    this.isAtEnd = true;
    this.filtered = () => {};
    this.search = 0;
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#apply();
    });
    page.querySelector("[data-first-error]").addEventListener("click", () => this.#find(""));
    this.buttons.earlier.addEventListener("click", () => this.#earlier());
    this.buttons.later.addEventListener("click", () => this.#later());
    this.buttons.follow.addEventListener("click", async () => {
      await this.load();
      this.filtered();
    });
  }

  /** Call this when the stream must begin anew. */
  onFilter(callback) {
    this.filtered = callback;
  }

  /** The last lines. */
  async load() {
    const window = await this.#read({});
    if (window) this.replace(window);
  }

  /** A window at the end of the log in place of what is shown. */
  replace(window) {
    this.isAtEnd = true;
    this.#put(window);
    if (window.skipped) this.state.textContent = `${size(window.skipped)} arrived at once and are left out here; Earlier lines reads them`;
    this.place.scrollTop = this.place.scrollHeight;
  }

  /** New lines of the stream. */
  add(window) {
    const before = this.last;
    this.last = window.last;
    if (this.isAtEnd && this.#count() > 2 * MOST) {
      // the person reads what is further up: these lines wait
      this.isAtEnd = this.buttons.later.hidden = this.buttons.follow.hidden = false;
      this.end = before;
    }
    if (!this.isAtEnd) {
      this.state.textContent = "There are new lines.";
      return;
    }
    const isBelow = this.place.scrollHeight - this.place.scrollTop - this.place.clientHeight < NEAR;
    this.place.append(block(window.lines));
    if (!isBelow) return;
    this.#trim();
    this.place.scrollTop = this.place.scrollHeight;
  }

  #put(window) {
    [this.first, this.end] = [window.first, window.last];
    if (this.isAtEnd) this.last = window.last;
    this.place.replaceChildren(block(window.lines));
    this.state.textContent = window.lines.length ? "" : "There are no lines yet.";
    this.buttons.earlier.hidden = !window.more;
    this.buttons.later.hidden = this.buttons.follow.hidden = this.isAtEnd;
  }

  #count() {
    return [...this.place.children].reduce((sum, each) => sum + each.childElementCount, 0);
  }

  /** Drop the first blocks; they can be read again. */
  #trim() {
    let count = this.#count();
    while (count > MOST && this.place.childElementCount > 1) {
      count -= this.place.firstElementChild.childElementCount;
      this.first = null; // the place is no longer known: the lines before the first one are found by reading back from the end
      this.place.firstElementChild.remove();
      this.buttons.earlier.hidden = false;
    }
  }

  async #earlier() {
    if (!this.first) {
      await this.load();
      this.isAtEnd = true;
    }
    const window = await this.#read({ before: JSON.stringify(this.first) });
    if (!window) return;
    const height = this.place.scrollHeight;
    this.place.prepend(block(window.lines));
    this.first = window.first;
    this.buttons.earlier.hidden = !window.more;
    this.place.scrollTop += this.place.scrollHeight - height;
  }

  async #later() {
    const window = await this.#read({ after: JSON.stringify(this.end) });
    if (!window) return;
    this.place.append(block(window.lines));
    this.end = window.last;
    if (!window.more) {
      await this.load();
      this.filtered();
    }
  }

  async #apply() {
    const fields = new FormData(this.form);
    const filter = Object.fromEntries(["node", "rank", "attempt"].map((name) => [name, fields.get(name).trim()]));
    const isOther = JSON.stringify(filter) !== JSON.stringify({ node: "", rank: "", attempt: "", ...this.filter });
    this.filter = filter;
    if (isOther || !this.isAtEnd) {
      await this.load();
      this.filtered();
    }
    const text = fields.get("text");
    if (text) await this.#find(text);
    else this.#endSearch();
  }

  #endSearch() {
    this.search += 1;
    this.found.replaceChildren();
    this.found.hidden = true;
  }

  /** Search from the beginning, a part at a time; no text: the first errors. */
  async #find(text) {
    this.#endSearch();
    const search = this.search;
    let place = "{}";
    let count = 0;
    for (let number = 1; number <= SEARCHED; number++) {
      this.state.textContent = `Searching, part ${number} …`;
      const part = await this.#read({ text, place }, "/search");
      if (!part || search !== this.search) return;
      part.lines.forEach((line, i) => this.#hit(line, part.positions[i]));
      count += part.lines.length;
      place = JSON.stringify(part.place);
      if (part.over || count >= 100) break;
    }
    const what = text ? "lines with this text" : "errors, the first of each log";
    this.state.textContent = count ? `${count}${count >= 100 ? " or more" : ""} ${what}` : `No ${text ? "line has this text" : "line looks like an error"}.`;
    this.found.hidden = count === 0;
    if (!text && count) this.found.querySelector("button").click();
  }

  #hit(line, position) {
    const button = document.createElement("button");
    button.type = "button";
    button.className = "quiet";
    button.append(...parts(line));
    button.addEventListener("click", () => this.#show(line, position));
    const entry = document.createElement("li");
    entry.append(button);
    this.found.append(entry);
  }

  /** The lines around one that was found, of its node alone. */
  async #show([time, attempt, node, , , text], position) {
    this.filter = { node: String(node), rank: "", attempt: String(attempt) };
    this.form.elements.node.value = node;
    this.form.elements.rank.value = "";
    this.form.elements.attempt.value = attempt;
    const window = await this.#read({ around: JSON.stringify({ [`${attempt}/${node}`]: position }) });
    if (!window) return;
    this.isAtEnd = false;
    this.#put(window);
    const shown = [...this.place.querySelectorAll(".line")];
    const hit = shown.find((each) => each.dataset.time === time && each.lastElementChild.textContent === clean(text));
    hit?.classList.add("hit");
    hit?.scrollIntoView({ block: "center" });
  }

  async #read(query, path = "") {
    const url = new URL(this.address + path, location.origin);
    for (const [name, value] of Object.entries({ ...this.filter, ...query })) if (value) url.searchParams.set(name, value);
    try {
      const response = await fetch(url, { headers: { Accept: "application/json" } });
      const data = await response.json();
      if (response.ok) return data;
      show(data.message ?? `${response.status}`, true);
    } catch {
      show("the server can't be reached; try again", true);
    }
    return null;
  }
}

/** Lines that came together as one element, which is dropped as one. */
function block(lines) {
  const whole = document.createElement("div");
  whole.className = "block";
  for (const line of lines) {
    const row = document.createElement("div");
    row.className = "line";
    row.dataset.time = line[0];
    if (ERROR.test(line[5])) row.classList.add("error");
    row.append(...parts(line));
    whole.append(row);
  }
  return whole;
}

function parts([time, attempt, node, rank, , text]) {
  const origin = document.createElement("span");
  origin.className = "origin";
  origin.textContent = `${time.slice(11, 23)} ${attempt}.${node} ${rank === null ? "node" : `rank ${rank}`}`;
  const words = document.createElement("span");
  words.textContent = clean(text);
  return [origin, " ", words];
}

/** Text without terminal colours; other control characters, also those that turn the direction of writing, are shown as signs. */
function clean(text) {
  return text.replace(COLOURS, "").replace(CONTROL, "\ufffd");
}

function size(bytes) {
  return bytes < 1e6 ? `${Math.ceil(bytes / 1e3)} kB` : `${(bytes / 1e6).toFixed(1)} MB`;
}
