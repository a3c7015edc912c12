// How long something is past, renewed every second.
const UNITS = [[86400, "d"], [3600, "h"], [60, "min"]];

/** As `orchestrator.console.formats.duration` writes it. */
export function duration(seconds) {
  let left = Math.max(0, Math.floor(seconds));
  if (left < 60) return `${left} s`;
  const parts = [];
  for (const [size, unit] of UNITS) {
    const amount = Math.floor(left / size);
    left %= size;
    if (amount || parts.length) parts.push([amount, unit]);
  }
  return parts.slice(0, 2).filter(([amount]) => amount).map((part) => part.join(" ")).join(" ");
}

export function renewTimes() {
  for (const place of document.querySelectorAll("time[data-since]")) {
    const text = duration((Date.now() - Date.parse(place.getAttribute("datetime"))) / 1000);
    if (place.textContent !== text) place.textContent = text;
  }
}

export function startTimes() {
  renewTimes();
  setInterval(() => document.hidden || renewTimes(), 1000);
}
