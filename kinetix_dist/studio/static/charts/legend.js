// The legend of a chart: names, the last values at rest, those at the pointer otherwise. Its size does not depend on them.
import { date, short } from "../base/format.js";
import { html } from "../base/html.js";
import { lineStyle } from "../base/theme.js";

/** @typedef {import("./line_chart.js").Line} Line */

/**
 * `hidden`: labels of lines that are not drawn. Values are written by `showValues`, many times per second.
 * @param {{ lines: Line[], hidden: Set<string>, toggle: ((label: string) => void) | null, hold: (element: HTMLElement | null) => void }} props
 */
export function Legend({ lines, hidden, toggle, hold }) {
  return html`<div class="legend" ref=${hold}>
    <span class="at"></span>
    ${lines.map((line, index) => {
      const { name, dash } = lineStyle(line.style ?? index);
      const style = { borderColor: `var(--${name})`, borderTopStyle: !dash.length ? "solid" : dash[0] > 2 ? "dashed" : "dotted" };
      const entry = html`<i style=${style}></i><span class="label">${line.label}</span><span class="value"></span>${line.low ? html`<span class="range"></span>` : null}`;
      return toggle ? html`<button key=${line.label} class="entry" aria-pressed=${!hidden.has(line.label)} title="shown or hidden" onClick=${() => toggle(line.label)}>${entry}</button>`
        : html`<span key=${line.label} class="entry">${entry}</span>`;
    })}</div>`;
}

/** Writes the values at a place of the axis, of each line its last value where it is null.
 * @param {HTMLElement} legend @param {{ x: number[], lines: Line[], axis: string, values: (number | null | undefined)[][] }} shown
 * @param {number | null} place */
export function showValues(legend, { x, lines, axis, values }, place) {
  const at = place ?? x.length - 1;
  const where = x.length ? (axis === "date" ? date(x[at]) : `${short(x[at], 4)} ${axis}`) : "";
  write(legend.querySelector(".at"), where && (place === null ? `last, at ${where}` : `at ${where}`));
  legend.querySelectorAll(".entry").forEach((entry, k) => {
    const index = place ?? values[k]?.findLastIndex((value) => value !== null && value !== undefined) ?? -1;
    write(entry.querySelector(".value"), short(values[k]?.[index]));
    const low = lines[k]?.low?.[index];
    const high = lines[k]?.high?.[index];
    const isKnown = low !== null && low !== undefined && high !== null && high !== undefined;
    write(entry.querySelector(".range"), isKnown ? `${short(low)} to ${short(high)}` : "");
  });
}

/** @param {Element | null} element @param {string} text */
function write(element, text) {
  if (element && element.textContent !== text) element.textContent = text;
}
