// Charts of curves, as SVG: the server sends few points, and the page's own styles give them their colours. See the docstring of
// orchestrator/console/curves.py.
import { show } from "./forms.js";

const SVG = "http://www.w3.org/2000/svg";
const [WIDTH, HEIGHT] = [600, 220];
const [LEFT, RIGHT, TOP, BOTTOM] = [62, 10, 8, 40];
const COLOURS = 6;
const POINTS = 300;
const MOST = 3 * POINTS;
const RANK = "rank_collect_seconds/";
const AXES = ["env_steps", "total_seconds"];
const HIDDEN = new Set([...AXES, "time", "iteration_seconds", "slowest_rank", "score_error", "iteration"]);
let clips = 0;

/** The charts of a run, by label: which metrics each has. `labels`: of the algorithms' metrics. */
function groupsOf(labels) {
  const one = (label, ...names) => ({ label, fits: (name) => names.includes(name) });
  return [
    one("Reward", "reward", "score"),
    { label: "Reward terms", fits: (name) => name.startsWith("reward_") },
    one("Episode length", "episode_length"),
    one("Success", "success"),
    { label: "How episodes end", fits: (name) => name.startsWith("termination_") },
    { label: "Losses", fits: (name) => name.endsWith("_loss") || name === "loss" },
    ...Object.entries(labels).map(([name, label]) => one(label, name)),
    one("Environment steps per second", "steps_per_second"),
    { ...one("Simulation, learning and saving [s per iteration]", "collect_seconds", "learn_seconds", "stall_seconds"), isStacked: true },
    { label: "Simulation of each rank [s per iteration]", fits: (name) => name.startsWith(RANK) },
    one("Slowest rank [share over the median]", "slowest_excess"),
  ];
}

/** A number as a person reads it, in about four digits. */
function shown(value) {
  if (value == null) return "–";
  const size = Math.abs(value);
  if (size && (size >= 1e5 || size < 1e-3)) return value.toExponential(2).replace("e+", "e");
  return Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(4)));
}

/** The exponential mean of values, as TensorBoard's smoothing has it; weight: 0 is none. */
function smoothed(values, weight) {
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
    this.clip = `clip-${++clips}`;
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
    this.#point(Math.min(this.at, data.x.length - 1));
  }

  #frame(label) {
    const frame = drawn("g", { class: "axes" });
    const clip = drawn("clipPath", { id: this.clip });
    clip.append(drawn("rect", { x: LEFT, y: 0, width: WIDTH - LEFT - RIGHT, height: HEIGHT - BOTTOM }));
    frame.append(clip);
    for (const value of ticks(...this.ys, 4)) {
      const y = this.#y(value);
      frame.append(drawn("line", { x1: LEFT, x2: WIDTH - RIGHT, y1: y, y2: y }));
      frame.append(drawn("text", { x: LEFT - 6, y: y + 4, "text-anchor": "end" }, shown(value)));
    }
    for (const value of ticks(...this.xs, 5)) {
      frame.append(drawn("text", { x: this.#x(value), y: HEIGHT - BOTTOM + 16, "text-anchor": "middle" }, shown(value)));
    }
    frame.append(drawn("text", { x: WIDTH - RIGHT, y: HEIGHT - 6, "text-anchor": "end" }, label));
    return frame;
  }

  #line({ y, low, high }, index) {
    const { x } = this.data;
    const parts = [];
    if (low && high) {
      const known = x.map((_, i) => i).filter((i) => low[i] != null && high[i] != null);
      const edge = [...known.map((i) => [x[i], high[i]]), ...known.reverse().map((i) => [x[i], low[i]])];
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
  #point(at) {
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
      this.#point(nearest(this.data.x, value));
      if (from !== null) this.#mark(from, value);
    });
    this.picture.addEventListener("pointerleave", () => this.data?.x.length && this.#point(-1));
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
      this.#point(Math.min(this.data.x.length - 1, Math.max(0, start)));
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

/** The curves of a run: a window of iterations for all charts, and what comes in as it trains. */
export class RunCurves {
  /** @param {HTMLElement} place  of the macro `curves_of` */
  constructor(place) {
    this.place = place;
    this.groups = groupsOf(JSON.parse(place.dataset.labels));
    this.window = null;
    this.data = { iterations: [], series: {} };
    this.last = null;
    this.charts = new Map();
    [this.axis, this.smooth, this.whole, this.more] = ["axis", "smooth", "whole", "more"].map((each) => place.querySelector(`[data-${each}]`));
    for (const choice of [this.axis, this.smooth]) choice.addEventListener("change", () => this.#draw());
    this.more.addEventListener("toggle", () => this.#draw());
    this.whole.addEventListener("click", () => this.#choose(null));
  }

  /** Read the window, thinned by the server. */
  async load() {
    const url = new URL(this.place.dataset.curves, location.origin);
    for (const name of this.place.dataset.metrics.split(" ").filter(Boolean)) url.searchParams.append("name", name);
    for (const name of url.searchParams.has("name") ? AXES : []) url.searchParams.append("name", name);
    for (const [name, value] of Object.entries({ ...this.window, points: POINTS })) url.searchParams.set(name, value);
    try {
      const response = await fetch(url, { headers: { Accept: "application/json" } });
      const data = await response.json();
      if (!response.ok) throw new Error(data.message);
      this.data = data;
      this.last = data.last;
      this.#draw();
    } catch (error) {
      show(`the curves can't be read: ${error.message}`, true);
    }
  }

  /** Iterations that the stream brought. */
  add(data) {
    if (data.again) return this.load();
    this.last = Math.max(this.last ?? 0, data.iterations.at(-1) ?? 0);
    if (this.window) return undefined; // the person looks at the past
    const { iterations, series } = this.data;
    const fresh = data.iterations.findIndex((each) => each > (iterations.at(-1) ?? 0));
    if (fresh < 0) return undefined;
    for (const name of new Set([...Object.keys(series), ...Object.keys(data.series)])) {
      series[name] ??= iterations.map(() => null);
      series[name].push(...(data.series[name] ?? data.iterations.map(() => null)).slice(fresh));
    }
    iterations.push(...data.iterations.slice(fresh));
    if (iterations.length > MOST) return this.load();
    this.#draw();
    return undefined;
  }

  #draw() {
    this.waiting ??= requestAnimationFrame(() => {
      this.waiting = null;
      this.#drawNow();
    });
  }

  #drawNow() {
    const names = Object.keys(this.data.series).filter((name) => !HIDDEN.has(name));
    const rest = names.filter((name) => !this.groups.some((group) => group.fits(name)));
    this.place.querySelector("[data-no-curves]").hidden = this.data.iterations.length > 0;
    this.more.hidden = !rest.length;
    for (const group of this.groups) this.#chart(group, names.filter(group.fits), this.place.querySelector("[data-charts]"));
    for (const name of this.more.open ? rest : []) this.#chart({ label: name }, [name], this.more.querySelector(".charts"));
  }

  #chart(group, names, place) {
    if (!names.length) return;
    if (!this.charts.has(group.label)) {
      const figure = document.createElement("figure");
      place.append(figure);
      figure.addEventListener("window", (event) => this.#choose(event.detail));
      this.charts.set(group.label, new Chart(figure, group));
    }
    const axis = this.axis.value;
    const x = AXES.includes(axis) ? this.data.series[axis] ?? [] : this.data.iterations;
    const weight = Number(this.smooth.value);
    const lines = names.map((name) => ({ name: name.replace(RANK, "rank "), y: smoothed(this.data.series[name], weight) }));
    this.charts.get(group.label).draw({ x, xLabel: this.axis.selectedOptions[0].textContent, lines });
  }

  /** Another window, given in what the charts are drawn against; null: the whole history. */
  #choose(chosen) {
    let window = chosen;
    if (chosen && AXES.includes(this.axis.value)) {
      const x = this.data.series[this.axis.value];
      const inside = this.data.iterations.filter((_, i) => x[i] >= chosen.from && x[i] <= chosen.to);
      if (inside.length < 2) return;
      window = { from: inside[0], to: inside.at(-1) };
    }
    this.window = window;
    this.whole.hidden = !window;
    this.load();
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

function nearest(values, target) {
  let best = 0;
  values.forEach((value, i) => {
    if (value != null && Math.abs(value - target) < Math.abs((values[best] ?? Infinity) - target)) best = i;
  });
  return best;
}

/** An element of an SVG. */
function drawn(name, attributes, text = "") {
  const element = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  element.append(text);
  return element;
}

function made(name, text) {
  const element = document.createElement(name);
  element.append(text);
  return element;
}
