// Charts of curves, as SVG: the server sends few points, and the page's own styles give them their colours. See the docstring of
// orchestrator/console/curves.py.
const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT] = [600, 220];
const [LEFT, RIGHT, TOP, BOTTOM] = [62, 10, 8, 40];
const COLOURS = 6;
let counted = 0;

/**
 * Read a window of a run's curves.
 * @param {string} address
 * @param {{names?: string[], from?: number, to?: number, points?: number}} window
 * @returns {Promise<{iterations: number[], series: Object<string, (number|null)[]>, last: number}>}
 */
export async function read(address, { names = [], from, to, points } = {}) {
  const url = new URL(address, location.origin);
  for (const name of names) url.searchParams.append("name", name);
  for (const [name, value] of Object.entries({ from, to, points })) if (value != null) url.searchParams.set(name, value);
  const answer = await fetch(url, { headers: { Accept: "application/json" } });
  if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).message ?? `${answer.status}`);
  return answer.json();
}

/** A number as a person reads it, in about four digits. */
export function shown(value) {
  if (value == null) return "–";
  const size = Math.abs(value);
  if (size && (size >= 1e5 || size < 1e-3)) return value.toExponential(2).replace("e+", "e");
  return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4)));
}

/** The exponential mean of values, as TensorBoard's smoothing has it; weight: 0 is none. */
export function smoothed(values, weight) {
  if (!weight) return values;
  let mean = 0;
  let total = 0;
  return values.map((value) => {
    if (value == null) return null;
    mean = mean * weight + (1 - weight) * value;
    total = total * weight + (1 - weight);
    return mean / total;
  });
}

export class Chart {
  /** @param {HTMLElement} place  an empty <figure>  @param {{label: string, isStacked?: boolean}} options */
  constructor(place, { label, isStacked = false }) {
    this.place = place;
    this.isStacked = isStacked;
    this.data = null;
    this.at = -1;
    place.classList.add("chart");
    const caption = made("figcaption", label);
    this.picture = drawn("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": label, tabindex: "0" });
    this.legend = document.createElement("ul");
    this.legend.className = "legend";
    this.clip = `clip-${++counted}`;
    place.replaceChildren(caption, this.picture, this.legend);
    this.#listen();
  }

  /** @param {{x: number[], xLabel?: string, lines: {name: string, y: (number|null)[], low?: number[], high?: number[]}[]}} data */
  draw(data) {
    this.data = data;
    const lines = this.isStacked ? stacked(data.lines) : data.lines;
    const all = lines.flatMap((line) => [line.y, line.low ?? [], line.high ?? []]).flat().filter((value) => value != null);
    this.place.dataset.points = data.x.length;
    this.xs = ends(data.x.filter((value) => value != null));
    this.ys = ends(all, this.isStacked);
    const parts = [this.#frame(data.xLabel ?? "")];
    const group = drawn("g", { "clip-path": `url(#${this.clip})` });
    lines.forEach((line, index) => group.append(...this.#line(line, index)));
    this.cursor = drawn("line", { class: "cursor", y1: TOP, y2: HEIGHT - BOTTOM, x1: -9, x2: -9 });
    this.brush = drawn("rect", { class: "brush", y: TOP, height: HEIGHT - TOP - BOTTOM, x: 0, width: 0 });
    this.picture.replaceChildren(...parts, group, this.brush, this.cursor);
    this.#tell(Math.min(this.at, data.x.length - 1));
  }

  #frame(label) {
    const frame = drawn("g", { class: "axes" });
    const clip = drawn("clipPath", { id: this.clip });
    clip.append(drawn("rect", { x: LEFT, y: 0, width: WIDTH - LEFT - RIGHT, height: HEIGHT - BOTTOM }));
    frame.append(clip);
    for (const value of ticks(...this.ys, 4)) {
      const y = this.#y(value);
      frame.append(drawn("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y, y2: y }));
      frame.append(written(shown(value), { x: LEFT - 6, y: y + 4, "text-anchor": "end" }));
    }
    for (const value of ticks(...this.xs, 5)) {
      frame.append(written(shown(value), { x: this.#x(value), y: HEIGHT - BOTTOM + 16, "text-anchor": "middle" }));
    }
    frame.append(written(label, { x: WIDTH - RIGHT, y: HEIGHT - 6, "text-anchor": "end" }));
    return frame;
  }

  #line({ y, low, high }, index) {
    const { x } = this.data;
    const parts = [];
    if (low && high) {
      const there = x.map((_, i) => i).filter((i) => low[i] != null && high[i] != null);
      const edge = [...there.map((i) => [x[i], high[i]]), ...there.reverse().map((i) => [x[i], low[i]])];
      const points = edge.map(([at, value]) => `${this.#x(at).toFixed(1)},${this.#y(value).toFixed(1)}`).join(" ");
      parts.push(drawn("polygon", { class: `band ${colour(index)}`, points }));
    }
    let path = "";
    let isDown = false;
    x.forEach((at, i) => {
      if (y[i] == null || at == null) isDown = false;
      else {
        path += `${isDown ? "L" : "M"}${this.#x(at).toFixed(1)} ${this.#y(y[i]).toFixed(1)}`;
        if (!isDown && (i + 1 === x.length || y[i + 1] == null)) path += "h1"; // a point alone is seen, too
        isDown = true;
      }
    });
    parts.push(drawn("path", { class: `curve ${colour(index)}`, d: path || "M0 0" }));
    return parts;
  }

  #x(value) {
    return LEFT + ((value - this.xs[0]) / (this.xs[1] - this.xs[0])) * (WIDTH - LEFT - RIGHT);
  }

  #y(value) {
    return HEIGHT - BOTTOM - ((value - this.ys[0]) / (this.ys[1] - this.ys[0])) * (HEIGHT - TOP - BOTTOM);
  }

  /** The values at a point (the last ones where none is marked) beside the names. */
  #tell(at) {
    this.at = at;
    const { x, xLabel, lines } = this.data;
    const entries = lines.map((line, index) => {
      const entry = document.createElement("li");
      const sign = drawn("svg", { viewBox: "0 0 24 6", class: "sign", "aria-hidden": "true" });
      sign.append(drawn("path", { class: `curve ${colour(index)}`, d: "M0 3H24" }));
      entry.append(sign, ` ${line.name} `, made("b", shown(at < 0 ? line.y.findLast((value) => value != null) : line.y[at])));
      return entry;
    });
    if (at >= 0) entries.unshift(made("li", `${xLabel ?? ""} ${shown(x[at])}:`));
    this.legend.replaceChildren(...entries);
    const where = at < 0 ? -9 : this.#x(x[at]);
    this.cursor.setAttribute("x1", where);
    this.cursor.setAttribute("x2", where);
  }

  #listen() {
    let from = null;
    const valueAt = (event) => {
      const box = this.picture.getBoundingClientRect();
      const share = ((event.clientX - box.left) / box.width) * WIDTH;
      const part = Math.min(1, Math.max(0, (share - LEFT) / (WIDTH - LEFT - RIGHT)));
      return this.xs[0] + part * (this.xs[1] - this.xs[0]);
    };
    this.picture.addEventListener("pointermove", (event) => {
      if (!this.data?.x.length) return;
      const value = valueAt(event);
      this.#tell(nearest(this.data.x, value));
      if (from !== null) this.#mark(from, value);
    });
    this.picture.addEventListener("pointerleave", () => this.data?.x.length && this.#tell(-1));
    this.picture.addEventListener("pointerdown", (event) => {
      if (event.pointerType !== "mouse" || !this.data?.x.length) return; // a finger scrolls the page
      from = valueAt(event);
      this.picture.setPointerCapture(event.pointerId);
    });
    this.picture.addEventListener("pointerup", (event) => {
      if (from === null) return;
      const [low, high] = [from, valueAt(event)].sort((a, b) => a - b);
      from = null;
      this.#mark(0, 0);
      if (high - low > (this.xs[1] - this.xs[0]) / 50) this.#choose({ from: Math.floor(low), to: Math.ceil(high) });
    });
    this.picture.addEventListener("dblclick", () => this.#choose(null));
    this.picture.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (event.key === "Escape") this.#choose(null);
      if (!step || !this.data?.x.length) return;
      event.preventDefault();
      const start = this.at < 0 ? this.data.x.length - 1 : this.at + step;
      this.#tell(Math.min(this.data.x.length - 1, Math.max(0, start)));
    });
  }

  #mark(from, to) {
    const [low, high] = [from, to].sort((a, b) => a - b);
    this.brush.setAttribute("x", from === to ? 0 : this.#x(low));
    this.brush.setAttribute("width", from === to ? 0 : this.#x(high) - this.#x(low));
  }

  #choose(detail) {
    this.place.dispatchEvent(new CustomEvent("window", { detail }));
  }
}

function stacked(lines) {
  let below = [];
  return lines.map((line) => {
    const low = line.y.map((_, i) => below[i] ?? 0);
    const high = line.y.map((value, i) => low[i] + (value ?? 0));
    below = high;
    return { ...line, y: high, low, high };
  });
}

function colour(index) {
  return `colour-${(index % COLOURS) + 1} dashes-${Math.floor(index / COLOURS) % 3}`;
}

/** Least and greatest of the values, never the same. */
function ends(values, fromZero = false) {
  let low = fromZero ? 0 : Infinity;
  let high = -Infinity;
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low > high) return [0, 1];
  const room = low === high ? Math.abs(low) / 2 || 0.5 : 0;
  return [low - room, high + room];
}

function ticks(low, high, count) {
  const rough = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((each) => each * power >= rough);
  const found = [];
  for (let i = Math.ceil(low / step); i * step <= high; i++) found.push(Number((i * step).toPrecision(10)));
  return found;
}

function nearest(values, wanted) {
  let best = 0;
  values.forEach((value, i) => {
    if (value != null && Math.abs(value - wanted) < Math.abs((values[best] ?? Infinity) - wanted)) best = i;
  });
  return best;
}

function drawn(name, attributes) {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  return element;
}

function written(text, attributes) {
  const element = drawn("text", attributes);
  element.textContent = text;
  return element;
}

function made(name, text) {
  const element = document.createElement(name);
  element.textContent = text;
  return element;
}
