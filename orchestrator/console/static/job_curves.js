// The curves of a training: charts by what belongs together, a window of iterations for all of them, and what comes in as it trains.
import { Chart, read, smoothed } from "./curves.js";
import { show } from "./forms.js";

const POINTS = 300;
const MOST = 3 * POINTS;
const RANK = "rank_collect_seconds/";
const LEARNING = JSON.parse(document.querySelector("[data-learning]")?.dataset.learning ?? "{}");
const GROUPS = [
  { label: "Reward", fits: (name) => name === "reward" || name === "score" },
  { label: "Reward terms", fits: (name) => name.startsWith("reward_") },
  { label: "Episode length", fits: (name) => name === "episode_length" },
  { label: "How episodes end", fits: (name) => name.startsWith("termination_") },
  { label: "Losses", fits: (name) => name.endsWith("_loss") || name === "loss" },
  ...Object.entries(LEARNING).map(([own, label]) => ({ label, fits: (name) => name === own })),
  { label: "Environment steps a second", fits: (name) => name === "steps_per_second" },
  {
    label: "Simulation, learning and saving [s of an iteration]",
    fits: (name) => ["collect_seconds", "learn_seconds", "stall_seconds"].includes(name),
    isStacked: true,
  },
  { label: "Simulation of each rank [s of an iteration]", fits: (name) => name.startsWith(RANK) },
  { label: "Slowest rank [share over the median]", fits: (name) => name === "slowest_excess" },
];
const AXES = ["env_steps", "total_seconds"];
const HIDDEN = new Set([...AXES, "time", "iteration_seconds", "slowest_rank", "score_error", "iteration"]);

export class JobCurves {
  /** @param {HTMLElement} page  @param {string} address  of the run's curves */
  constructor(page, address) {
    this.page = page;
    this.address = address;
    this.window = null;
    this.data = { iterations: [], series: {} };
    this.last = null;
    this.charts = new Map();
    this.axis = page.querySelector("[data-axis]");
    this.smooth = page.querySelector("[data-smooth]");
    this.whole = page.querySelector("[data-whole]");
    this.more = page.querySelector("[data-more]");
    for (const choice of [this.axis, this.smooth]) choice.addEventListener("change", () => this.#draw());
    this.more.addEventListener("toggle", () => this.#draw());
    this.whole.addEventListener("click", () => this.#look(null));
  }

  /** Read the window, thinned by the server. */
  async load() {
    try {
      this.data = await read(this.address, { ...(this.window ?? {}), points: POINTS });
      this.last = this.data.last;
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
    if (this.waiting) return;
    this.waiting = requestAnimationFrame(() => {
      this.waiting = 0;
      this.#drawNow();
    });
  }

  #drawNow() {
    const names = Object.keys(this.data.series).filter((name) => !HIDDEN.has(name));
    this.page.querySelector("[data-no-curves]").hidden = this.data.iterations.length > 0;
    this.more.hidden = !names.some((name) => !GROUPS.some((group) => group.fits(name)));
    for (const group of GROUPS) this.#chart(group, names.filter(group.fits), this.page.querySelector("[data-charts]"));
    if (!this.more.open) return;
    const rest = names.filter((name) => !GROUPS.some((group) => group.fits(name)));
    for (const name of rest) this.#chart({ label: name }, [name], this.more.querySelector(".charts"));
  }

  #chart(group, names, place) {
    if (!names.length) return;
    if (!this.charts.has(group.label)) {
      const figure = document.createElement("figure");
      place.append(figure);
      figure.addEventListener("window", (event) => this.#look(event.detail));
      this.charts.set(group.label, new Chart(figure, group));
    }
    const axis = this.axis.value;
    const x = AXES.includes(axis) ? this.data.series[axis] ?? [] : this.data.iterations;
    const weight = Number(this.smooth.value);
    const lines = names.map((name) => ({ name: name.replace(RANK, "rank "), y: smoothed(this.data.series[name], weight) }));
    this.charts.get(group.label).draw({ x, xLabel: this.axis.selectedOptions[0].textContent, lines });
  }

  /** Another window, given in what the charts are drawn against; null: the whole history. */
  #look(chosen) {
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
