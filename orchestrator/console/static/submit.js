// The wizard and the YAML editor: the server says, while a person types, which YAML it is and what is wrong with it.
import { Editor } from "./editor.js";

const PAUSE = 350;
const NOWHERE = { key: "", line: 0, code_line: 0 };

class Checked {
  constructor(form) {
    this.form = form;
    this.editors = new Map([...form.querySelectorAll("[data-editor]")].map((box) => {
      const editor = new Editor(box);
      return [editor.field.name, editor];
    }));
    this.asking = null;
    form.addEventListener("input", () => this.soon());
    form.addEventListener("change", (event) => this.changed(event.target));
    this.yaml = this.editors.get("yaml");
    for (const kind of this.yaml ? ["keyup", "click"] : []) this.yaml.field.addEventListener(kind, () => this.moved());
    this.showAlgorithm();
  }

  soon() {
    clearTimeout(this.waiting);
    this.waiting = setTimeout(() => this.ask(false), PAUSE);
  }

  moved() {
    if (this.line !== this.yaml.line) this.soon();
  }

  changed(field) {
    if (field.name === "train.algorithm") this.showAlgorithm();
    clearTimeout(this.waiting);
    this.ask(this.editors.has(field.name)); // whoever leaves the code wants to know whether it works
  }

  showAlgorithm() {
    const chosen = this.form.elements["train.algorithm"]?.value;
    for (const group of this.form.querySelectorAll("[data-algorithm]")) group.hidden = group.dataset.algorithm !== chosen;
  }

  async ask(isWhole) {
    this.asking?.abort();
    const asking = (this.asking = new AbortController());
    const body = new URLSearchParams(new FormData(this.form));
    if (isWhole) body.set("whole", "yes");
    if (this.yaml) body.set("line", (this.line = this.yaml.line));
    try {
      const headers = { Accept: "application/json" };
      const response = await fetch(this.form.dataset.check, { method: "POST", body, headers, signal: asking.signal });
      const data = await response.json();
      this.report(response.ok ? data : { problem: { ...NOWHERE, message: data.message } });
    } catch (error) {
      if (error.name !== "AbortError") this.report({ problem: { ...NOWHERE, message: "the server can't be reached" } });
    }
  }

  report({ yaml, problem, notes = [], help }) {
    const shown = this.form.querySelector("[data-yaml]");
    if (shown && yaml !== undefined) shown.textContent = yaml;
    const words = problem ? (problem.key ? `${problem.key}: ` : "") + problem.message : "";
    put(this.form.querySelector("[data-problem]"), words);
    this.form.querySelector("[data-notes]").replaceChildren(...notes.map((note) => element("li", note)));
    this.point(problem, words);
    if (help) this.help(help);
  }

  /** Show a problem at its field, and at its line where the field is an editor. */
  point(problem, words) {
    const named = this.yaml ? (problem ? "yaml" : "") : this.nearest(problem?.key ?? "");
    for (const place of this.form.querySelectorAll("[data-wrong]")) {
      const isIt = place.dataset.wrong === named;
      put(place, isIt ? (this.yaml ? words : problem.message) : "");
      if (isIt) place.closest("details")?.setAttribute("open", "");
    }
    for (const field of this.form.elements) {
      if (field.name === named && named) field.setAttribute("aria-invalid", "true");
      else field.removeAttribute("aria-invalid");
    }
    for (const [name, editor] of this.editors) editor.mark(name !== named ? 0 : this.yaml ? problem.line : problem.code_line);
  }

  /** The field in which a key of the YAML stands. */
  nearest(key) {
    const names = [...this.form.elements].map((field) => field.name).filter((name) => name && `${key}.`.startsWith(`${name}.`));
    return names.reduce((best, name) => (name.length > best.length ? name : best), "");
  }

  help({ section, key, keys }) {
    const place = this.form.querySelector("[data-help]");
    place.querySelector("[data-help-section]").textContent = section || "Keys of a job";
    place.querySelector("[data-help-key]").textContent = key?.about ? `${key.name}: ${key.about}` : "";
    place.querySelector("dl").replaceChildren(...keys.map((each) => {
      const name = element("dt", "");
      name.append(element("code", each.name));
      name.className = each.present ? "present" : "";
      const pair = element("div", "");
      pair.append(name, element("dd", each.about));
      return pair;
    }));
  }
}

function put(place, text) {
  if (!place) return;
  place.textContent = text;
  place.hidden = !text;
}

function element(tag, text) {
  const made = document.createElement(tag);
  made.textContent = text;
  return made;
}

for (const form of document.querySelectorAll("form[data-check]")) new Checked(form);
