// Light or dark: as the system says, until the person chooses. The server writes the choice into the page, so that nothing flashes.
const DARK = matchMedia("(prefers-color-scheme: dark)");

export function startTheme() {
  const button = document.querySelector("[data-theme-switch]");
  const page = document.documentElement;
  const current = () => page.dataset.theme || (DARK.matches ? "dark" : "light");
  const label = () => (button.textContent = current() === "dark" ? "Light" : "Dark");
  button.hidden = false;
  label();
  DARK.addEventListener("change", label);
  button.addEventListener("click", () => {
    page.dataset.theme = current() === "dark" ? "light" : "dark";
    document.cookie = `muster-theme=${page.dataset.theme}; path=/; max-age=31536000; samesite=strict`;
    label();
    page.dispatchEvent(new CustomEvent("theme"));
  });
}
