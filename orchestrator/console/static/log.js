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
    const told = await this.#read({});
    if (told) this.replace(told);
  }

  /** A window at the end of the log in place of what is shown. */
  replace(told) {
    this.isAtEnd = true;
    this.#put(told);
    if (told.skipped) this.state.textContent = `${size(told.skipped)} came at once and are left out here; read them with Earlier lines`;
    this.place.scrollTop = this.place.scrollHeight;
  }

  /** New lines of the stream. */
  add(told) {
    const before = this.last;
    this.last = told.last;
    if (this.isAtEnd && this.#count() > 2 * MOST) {
      // the person reads what is further up: these lines wait
      this.isAtEnd = this.buttons.later.hidden = this.buttons.follow.hidden = false;
      this.end = before;
    }
    if (!this.isAtEnd) {
      this.state.textContent = "New lines have come.";
      return;
    }
    const isBelow = this.place.scrollHeight - this.place.scrollTop - this.place.clientHeight < NEAR;
    this.place.append(block(told.lines));
    if (!isBelow) return;
    this.#trim();
    this.place.scrollTop = this.place.scrollHeight;
  }

  #put(told) {
    [this.first, this.end] = [told.first, told.last];
    if (this.isAtEnd) this.last = told.last;
    this.place.replaceChildren(block(told.lines));
    this.state.textContent = told.lines.length ? "" : "There are no lines yet.";
    this.buttons.earlier.hidden = !told.more;
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
    const told = await this.#read({ before: JSON.stringify(this.first) });
    if (!told) return;
    const height = this.place.scrollHeight;
    this.place.prepend(block(told.lines));
    this.first = told.first;
    this.buttons.earlier.hidden = !told.more;
    this.place.scrollTop += this.place.scrollHeight - height;
  }

  async #later() {
    const told = await this.#read({ after: JSON.stringify(this.end) });
    if (!told) return;
    this.place.append(block(told.lines));
    this.end = told.last;
    if (!told.more) {
      await this.load();
      this.filtered();
    }
  }

  async #apply() {
    const given = new FormData(this.form);
    const filter = Object.fromEntries(["node", "rank", "attempt"].map((name) => [name, given.get(name).trim()]));
    const isOther = JSON.stringify(filter) !== JSON.stringify({ node: "", rank: "", attempt: "", ...this.filter });
    this.filter = filter;
    if (isOther || !this.isAtEnd) {
      await this.load();
      this.filtered();
    }
    const text = given.get("text");
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
    for (let part = 1; part <= SEARCHED; part++) {
      this.state.textContent = `Searching, part ${part} …`;
      const told = await this.#read({ text, place }, "/search");
      if (!told || search !== this.search) return;
      told.lines.forEach((line, i) => this.#hit(line, told.positions[i]));
      count += told.lines.length;
      place = JSON.stringify(told.place);
      if (told.over || count >= 100) break;
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
    const told = await this.#read({ around: JSON.stringify({ [`${attempt}/${node}`]: position }) });
    if (!told) return;
    this.isAtEnd = false;
    this.#put(told);
    const shown = [...this.place.querySelectorAll(".line")];
    const there = shown.find((each) => each.dataset.time === time && each.lastElementChild.textContent === clean(text));
    there?.classList.add("hit");
    there?.scrollIntoView({ block: "center" });
  }

  async #read(query, path = "") {
    const url = new URL(this.address + path, location.origin);
    for (const [name, value] of Object.entries({ ...this.filter, ...query })) if (value) url.searchParams.set(name, value);
    try {
      const answer = await fetch(url, { headers: { Accept: "application/json" } });
      const told = await answer.json();
      if (answer.ok) return told;
      show(told.message ?? `${answer.status}`, true);
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
