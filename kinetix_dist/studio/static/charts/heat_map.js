// Coloured cells with a label per row and column: the text of a cell stands below at the pointer, and in the CSV.
// Cells shrink where the page is narrow; what does not fit even then is scrolled.
import { html, useEffect, useRef, useState } from "../base/html.js";
import { colour } from "../base/theme.js";

const NARROWEST = 4; // pixels of a cell
const LABEL_SHARE = 0.4; // of the width, at most

/**
 * `values` 0 to 1, null: no cell. `texts`: meaning of each cell with its counts.
 * @param {{ rows: string[], columns: string[], values: (number | null)[][], texts: string[][], cellWidth?: number,
 *   cellHeight?: number, labelWidth?: number, choose?: (row: number, column: number) => void, chosen?: number | null,
 *   describe: string }} props
 */
export function HeatMap(props) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const note = useRef(/** @type {HTMLElement | null} */ (null));
  const frame = useRef(/** @type {HTMLElement | null} */ (null));
  const [space, setSpace] = useState(Infinity); // pixels in which it has to fit
  const { rows, columns, values, texts, cellHeight = 16 } = props;
  const footer = 18;
  const labelWidth = Math.round(Math.min(props.labelWidth ?? 150, LABEL_SHARE * space));
  const wanted = props.cellWidth ?? Math.min(44, Math.floor(760 / Math.max(columns.length, 1)));
  const cellWidth = Math.max(NARROWEST, Math.min(wanted, Math.floor((space - labelWidth - 10) / Math.max(columns.length, 1))));
  const width = labelWidth + columns.length * cellWidth + 10;
  const height = rows.length * cellHeight + footer;

  useEffect(() => {
    const element = /** @type {HTMLElement} */ (frame.current);
    const observer = new ResizeObserver(() => element.clientWidth && setSpace(element.clientWidth));
    observer.observe(element);
    return () => observer.disconnect();
  }, []);
  useEffect(() => {
    const draw = () => {
      const element = /** @type {HTMLCanvasElement} */ (canvas.current);
      const scale = devicePixelRatio || 1;
      element.width = width * scale;
      element.height = height * scale;
      const context = /** @type {CanvasRenderingContext2D} */ (element.getContext("2d"));
      context.scale(scale, scale);
      context.font = "11px sans-serif";
      context.textBaseline = "middle";
      rows.forEach((row, r) => {
        context.fillStyle = colour("ink-soft");
        context.textAlign = "right";
        context.fillText(fit(context, row, labelWidth - 8), labelWidth - 6, (r + 0.5) * cellHeight);
        columns.forEach((_, c) => {
          const value = values[r][c];
          context.fillStyle = value === null ? colour("grid") : heat(value);
          context.fillRect(labelWidth + c * cellWidth, r * cellHeight, cellWidth - 1, cellHeight - 1);
          if (value === null) return;
          const text = String(Math.round(100 * value));
          if (context.measureText(text).width + 5 <= cellWidth) {
            context.fillStyle = value > 0.55 ? "#10202c" : "#f2f5f7";
            context.textAlign = "center";
            context.fillText(text, labelWidth + (c + 0.5) * cellWidth, (r + 0.5) * cellHeight);
          }
        });
      });
      context.fillStyle = colour("ink-soft");
      context.textAlign = "center";
      const widest = Math.max(0, ...columns.map((column) => context.measureText(column).width));
      const every = Math.max(1, Math.ceil((widest + 6) / cellWidth));
      columns.forEach((column, c) => {
        if (c % every === 0) context.fillText(column, labelWidth + (c + 0.5) * cellWidth, height - footer / 2);
      });
      if (props.chosen !== null && props.chosen !== undefined) {
        context.strokeStyle = colour("accent");
        context.lineWidth = 2;
        context.strokeRect(labelWidth + props.chosen * cellWidth, 0, cellWidth - 1, rows.length * cellHeight);
      }
    };
    draw();
    addEventListener("themechange", draw);
    return () => removeEventListener("themechange", draw);
  });

  /** @param {any} event @returns {[number, number] | null} */
  const cellAt = (event) => {
    const box = /** @type {HTMLCanvasElement} */ (canvas.current).getBoundingClientRect();
    const c = Math.floor((event.clientX - box.left - labelWidth) / cellWidth);
    const r = Math.floor((event.clientY - box.top) / cellHeight);
    return r >= 0 && c >= 0 && r < rows.length && c < columns.length ? [r, c] : null;
  };
  const showNote = (/** @type {any} */ event) => {
    const cell = cellAt(event);
    if (note.current) note.current.textContent = cell ? texts[cell[0]][cell[1]] : "";
  };
  const click = (/** @type {any} */ event) => {
    const cell = cellAt(event);
    if (cell) props.choose?.(...cell);
  };
  return html`<div class="scroll" ref=${frame}><canvas class="heat" ref=${canvas} style=${{ width: `${width}px`, height: `${height}px` }} role="img"
      aria-label=${props.describe} onMouseMove=${showNote} onMouseLeave=${showNote} onClick=${click}></canvas></div>
    <p class="read-out"><span ref=${note}></span></p>`;
}

/** @param {CanvasRenderingContext2D} context @param {string} text @param {number} width */
function fit(context, text, width) {
  let shown = text;
  while (shown.length > 4 && context.measureText(shown).width > width) shown = `…${shown.slice(2)}`;
  return shown;
}

// From dark blue (0) over green to yellow (1): viridis, which colour-blind people read and which is even in grey.
const STOPS = [[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]];

/** @param {number} value 0 to 1 */
export function heat(value) {
  const place = Math.min(Math.max(value, 0), 1) * (STOPS.length - 1);
  const first = Math.min(Math.floor(place), STOPS.length - 2);
  const part = place - first;
  const mix = STOPS[first].map((from, k) => Math.round(from + part * (STOPS[first + 1][k] - from)));
  return `rgb(${mix.join(",")})`;
}
