// The charts of a run, renewed when its stream says that it went on.
import { fill } from "./bind.js";
import { Chart, read } from "./curves.js";

const region = document.querySelector("[data-curves]");
const charts = new Map();
let isReading = false;

async function draw() {
  if (isReading) return;
  isReading = true;
  try {
    const curves = await read(region.dataset.curves, { names: region.dataset.metrics.split(" ") });
    for (const [name, y] of Object.entries(curves.series)) {
      if (!charts.has(name)) {
        const figure = document.createElement("figure");
        region.append(figure);
        charts.set(name, new Chart(figure, { label: name }));
      }
      charts.get(name).draw({ x: curves.iterations, xLabel: "iteration", lines: [{ name, y }] });
    }
  } catch {
    // the server is away, or the volume; the stream says so, and the next change draws again
  } finally {
    isReading = false;
  }
}

document.addEventListener("changed", (event) => {
  fill(document.querySelector("[data-progress]"), event.detail);
  draw();
});
draw();
