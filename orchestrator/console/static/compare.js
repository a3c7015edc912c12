// The curves of several runs, each group with its spread; renewed while the page is looked at.
import { Chart } from "./curves.js";
import { show } from "./forms.js";

const AGAIN = 5000;
const region = document.querySelector("[data-curves]");
const choice = document.querySelector("[data-metric]");
let chart = null;
let drawn = "";
let chosen = 0;

async function draw() {
  const metric = choice.value;
  const mine = ++chosen;
  const url = new URL(region.dataset.curves, location.origin);
  url.searchParams.set("metric", metric);
  try {
    const response = await fetch(url, { headers: { Accept: "application/json" } });
    const data = await response.json();
    if (mine !== chosen) return; // another metric was chosen meanwhile
    if (!response.ok) return show(data.message, true);
    if (!chart || drawn !== metric) {
      const figure = document.createElement("figure");
      region.replaceChildren(figure);
      chart = new Chart(figure, { label: metric });
      drawn = metric;
    }
    chart.draw(data);
  } catch {
    // the server is unavailable; the next time draws again
  }
}

choice.addEventListener("change", draw);
setInterval(() => document.hidden || draw(), AGAIN);
draw();
