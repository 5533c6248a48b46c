// Bars of a few groups side by side, with an interval each where there is one; numbers stand above them.
import { html, useEffect, useRef } from "../base/html.js";
import { colour, lineStyle } from "../base/theme.js";

const HEIGHT = 200;
const LEFT = 44;
const BOTTOM = 32;
const TOP = 14;

/**
 * @typedef {{ label: string, values: (number | null)[], low?: (number | null)[], high?: (number | null)[],
 *   texts: string[] }} BarGroup
 */

/**
 * `texts`: meaning of each bar with its counts, shown next to the pointer.
 * @param {{ columns: string[], groups: BarGroup[], axis: string, max?: number, describe: string,
 *   format?: (value: number) => string }} props
 */
export function Bars({ columns, groups, axis, max, describe, format = (value) => value.toPrecision(2) }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const note = useRef(/** @type {HTMLElement | null} */ (null));
  const highest = max ?? 1.05 * Math.max(1e-9, ...groups.flatMap((group) => [...group.values, ...(group.high ?? [])].map((value) => value ?? 0)));
  const width = () => canvas.current?.parentElement?.clientWidth || 400;

  useEffect(() => {
    const draw = () => {
      const element = canvas.current;
      if (!element) return;
      const scale = devicePixelRatio || 1;
      element.width = width() * scale;
      element.height = HEIGHT * scale;
      const context = /** @type {CanvasRenderingContext2D} */ (element.getContext("2d"));
      context.scale(scale, scale);
      const place = layout(width(), columns.length, groups.length);
      const y = (/** @type {number} */ value) => HEIGHT - BOTTOM - (value / highest) * (HEIGHT - BOTTOM - TOP);
      context.font = "11px sans-serif";
      context.textBaseline = "middle";
      for (let k = 0; k <= 4; k++) {
        const value = (highest * k) / 4;
        context.fillStyle = colour("grid");
        context.fillRect(LEFT, y(value), width() - LEFT - 4, 1);
        context.fillStyle = colour("ink-soft");
        context.textAlign = "right";
        context.fillText(format(value), LEFT - 5, y(value));
      }
      context.textAlign = "center";
      const every = Math.ceil((columns.length * 34) / (width() - LEFT));
      columns.forEach((column, c) => {
        context.fillStyle = colour("ink-soft");
        if (c % every === 0) context.fillText(column, place.column(c) + place.columnWidth / 2, HEIGHT - BOTTOM + 9);
        groups.forEach((group, g) => {
          const value = group.values[c];
          if (value === null || value === undefined) return;
          const { stroke } = lineStyle(g);
          const left = place.bar(c, g);
          context.fillStyle = stroke;
          context.globalAlpha = g ? 0.55 : 0.9;
          context.fillRect(left, y(value), place.barWidth, HEIGHT - BOTTOM - y(value));
          context.globalAlpha = 1;
          const low = group.low?.[c];
          const high = group.high?.[c];
          if (low !== null && low !== undefined && high !== null && high !== undefined) {
            context.fillStyle = colour("ink");
            context.fillRect(left + place.barWidth / 2 - 0.75, y(high), 1.5, y(low) - y(high));
            context.fillRect(left + place.barWidth / 2 - 3, y(high), 6, 1.5);
            context.fillRect(left + place.barWidth / 2 - 3, y(low) - 1, 6, 1.5);
          }
        });
      });
      context.fillStyle = colour("ink-soft");
      context.fillText(axis, LEFT + (width() - LEFT) / 2, HEIGHT - 7);
    };
    draw();
    const observer = new ResizeObserver(draw);
    if (canvas.current?.parentElement) observer.observe(canvas.current.parentElement);
    addEventListener("themechange", draw);
    return () => {
      observer.disconnect();
      removeEventListener("themechange", draw);
    };
  });

  const showNote = (/** @type {any} */ event) => {
    const box = /** @type {HTMLCanvasElement} */ (canvas.current).getBoundingClientRect();
    const place = layout(width(), columns.length, groups.length);
    const c = Math.floor((event.clientX - box.left - LEFT) / place.pitch);
    if (note.current) note.current.textContent = c >= 0 && c < columns.length ? groups.map((group) => `${group.label}: ${group.texts[c]}`).join(" · ") : "";
  };
  return html`<div><canvas class="bars" ref=${canvas} style=${{ width: "100%", height: `${HEIGHT}px` }} role="img" aria-label=${describe}
      onMouseMove=${showNote} onMouseLeave=${() => note.current && (note.current.textContent = "")}></canvas>
    <p class="keys">${groups.map((group, g) => html`<span key=${group.label} class="key"><i style=${{ background: lineStyle(g).stroke, opacity: g ? 0.55 : 0.9 }}></i>${group.label}</span>`)}</p>
    <p class="read-out"><span ref=${note}></span></p></div>`;
}

/** @param {number} width @param {number} numColumns @param {number} numGroups */
function layout(width, numColumns, numGroups) {
  const pitch = (width - LEFT - 6) / Math.max(numColumns, 1);
  const columnWidth = Math.min(pitch * 0.8, 70 * numGroups);
  const barWidth = columnWidth / numGroups;
  const column = (/** @type {number} */ c) => LEFT + c * pitch + (pitch - columnWidth) / 2;
  return { pitch, columnWidth, barWidth, column, bar: (/** @type {number} */ c, /** @type {number} */ g) => column(c) + g * barWidth };
}
