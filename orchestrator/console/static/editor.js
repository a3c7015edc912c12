// A code editor on a text field: line numbers, indentation, the mark of a line with an error. The text stays the text field's own,
// so that forms, undo, spell checkers and screen readers know it.
const INDENT = "    ";

/** @param {HTMLElement} box  of the macro `editor`: has one `<textarea>` */
export class Editor {
  constructor(box) {
    this.field = box.querySelector("textarea");
    this.numbers = document.createElement("div");
    this.numbers.className = "numbers";
    this.numbers.setAttribute("aria-hidden", "true");
    box.prepend(this.numbers);
    this.indent = this.field.name === "yaml" ? "  " : INDENT;
    this.marked = Number(box.dataset.line ?? 0);
    this.mayLeave = false;
    this.field.addEventListener("input", () => this.count());
    this.field.addEventListener("scroll", () => (this.numbers.scrollTop = this.field.scrollTop));
    this.field.addEventListener("keydown", (event) => this.press(event));
    this.field.addEventListener("focus", () => (this.mayLeave = false));
    this.count();
  }

  /** The line of the cursor, from 1. */
  get line() {
    return this.field.value.slice(0, this.field.selectionStart).split("\n").length;
  }

  /** Mark a line as wrong; none with 0. */
  mark(line) {
    this.marked = line;
    this.count();
  }

  count() {
    const lines = this.field.value.split("\n").length;
    while (this.numbers.childElementCount > lines) this.numbers.lastElementChild.remove();
    while (this.numbers.childElementCount < lines) {
      const number = document.createElement("span");
      number.textContent = this.numbers.childElementCount + 1;
      this.numbers.append(number);
    }
    for (const old of this.numbers.querySelectorAll(".bad")) old.classList.remove("bad");
    this.numbers.children[this.marked - 1]?.classList.add("bad");
    this.numbers.scrollTop = this.field.scrollTop;
  }

  press(event) {
    if (event.ctrlKey || event.altKey || event.metaKey || event.isComposing) return;
    if (event.key === "Tab" && !this.mayLeave) {
      event.preventDefault();
      if (event.shiftKey) this.outdent();
      else this.insert(this.indent);
    } else if (event.key === "Enter") {
      event.preventDefault();
      const before = this.field.value.slice(0, this.field.selectionStart);
      const line = before.slice(before.lastIndexOf("\n") + 1);
      this.insert("\n" + line.match(/^ */)[0] + (line.trimEnd().endsWith(":") ? this.indent : ""));
    }
    this.mayLeave = event.key === "Escape" || (this.mayLeave && (event.key === "Tab" || event.key === "Shift"));
  }

  outdent() {
    const { selectionStart: place, value } = this.field;
    const start = value.lastIndexOf("\n", place - 1) + 1;
    const size = Math.min(value.slice(start).match(/^ */)[0].length, this.indent.length);
    if (!size) return;
    this.field.setSelectionRange(start, start + size);
    this.insert("");
    this.field.setSelectionRange(Math.max(start, place - size), Math.max(start, place - size));
  }

  /** As if it were typed, so that it can be undone. */
  insert(text) {
    const isDone = document.execCommand(text ? "insertText" : "delete", false, text);
    if (isDone) return;
    this.field.setRangeText(text, this.field.selectionStart, this.field.selectionEnd, "end");
    this.field.dispatchEvent(new Event("input", { bubbles: true }));
  }
}
