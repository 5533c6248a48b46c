// Dark or light: as the system has it, unless the person chose one. Colours are variables of style.css.

/** @param {string} name of a variable of style.css, without -- */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

export function isDark() {
  const chosen = document.documentElement.dataset.theme;
  return chosen ? chosen === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
}

export function restoreTheme() {
  const chosen = localStorage.getItem("kinetix-dist theme");
  if (chosen) document.documentElement.dataset.theme = chosen;
}

export function toggleTheme() {
  const chosen = isDark() ? "light" : "dark";
  localStorage.setItem("kinetix-dist theme", chosen);
  document.documentElement.dataset.theme = chosen;
  dispatchEvent(new Event("themechange"));
}

// Lines differ by their dashes too, not by colour alone. The colours are those of Okabe and Ito, distinguished by
// colour-blind people.
const LINES = ["line-0", "line-1", "line-2", "line-3", "line-4", "line-5", "line-6"];
const DASHES = [[], [7, 3], [2, 3], [10, 3, 2, 3]];

/** `name`: of the variable of style.css that has the colour. @param {number} index */
export function lineStyle(index) {
  const name = LINES[index % LINES.length];
  return { stroke: colour(name), dash: DASHES[Math.floor(index / LINES.length + index) % 4], name };
}
