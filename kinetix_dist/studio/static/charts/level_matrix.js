// Levels x evaluations: a row a level with its numbers and a strip of coloured cells. Only rows in sight exist; names and
// column labels stay in view; arrow keys move between rows.
import { html, useEffect, useMemo, useRef, useState } from "../base/html.js";
import { colour } from "../base/theme.js";
import { heat } from "./heat_map.js";

const ROW = 26; // pixels
const HEADER = 28;
const ROWS_AT_ONCE = 8; // that are added when scrolling comes near the end of those that exist
const SPARE_ROWS = 12; // above and below those in sight, so that scrolling shows no gaps
const MAX_CELL = 44;
const MIN_CELL = 7;
const LABEL = 40; // pixels that a label of a column needs
const NARROW = 640; // pixels of the table below which only names stay at the left

/**
 * @typedef {{ title: string, help: string, width: number, stays?: boolean }} NumberColumn stays: at the left, where it is wide
 * @typedef {{ key: string, name: string, values: (number | null)[], numbers: any[], isChecked: boolean }} MatrixRow
 */

/**
 * `rows` are equal objects while nothing changes; `columns` labels of the strip, `first` those that are never left out;
 * `describe` one cell for the note above.
 * @param {{ rows: MatrixRow[], numbers: NumberColumn[], columns: string[], first: string[], chosen: string | null,
 *   open: (row: MatrixRow) => void, check: (row: MatrixRow) => void, describe: (row: MatrixRow, column: number) => string,
 *   close: () => void, label: string }} props
 */
export function LevelMatrix({ rows, numbers, columns, first, chosen, open, check, describe, close, label }) {
  const scroller = useRef(/** @type {HTMLDivElement | null} */ (null));
  const note = useRef(/** @type {HTMLElement | null} */ (null));
  const cache = useRef(/** @type {WeakMap<MatrixRow, { state: string, drawn: any }>} */ (new WeakMap())).current;
  const [size, setSize] = useState({ width: 900, height: 500 });
  const [top, setTop] = useState(0); // number of the first row in sight, a multiple of ROWS_AT_ONCE
  const [current, setCurrent] = useState(0);
  const at = Math.min(current, Math.max(rows.length - 1, 0));

  useEffect(() => {
    const element = /** @type {HTMLDivElement} */ (scroller.current);
    const measure = () => setSize({ width: element.clientWidth, height: element.clientHeight });
    const observer = new ResizeObserver(measure);
    observer.observe(element);
    measure();
    return () => observer.disconnect();
  }, []);

  const isNarrow = size.width < NARROW;
  const nameWidth = isNarrow ? 124 : 220;
  const numbersWidth = numbers.reduce((sum, one) => sum + one.width, 0);
  const cell = Math.max(MIN_CELL, Math.min(MAX_CELL, Math.floor((size.width - nameWidth - numbersWidth - 4) / Math.max(columns.length, 1))));
  const width = nameWidth + numbersWidth + columns.length * cell;
  let left = nameWidth;
  const lefts = numbers.map((one) => {
    if (isNarrow || !one.stays) return null;
    left += one.width;
    return left - one.width;
  });
  const labelled = useMemo(() => labelledColumns(columns, first, cell), [columns, first, cell]);
  const from = Math.max(0, top - SPARE_ROWS);
  const to = Math.min(rows.length, top + Math.ceil(size.height / ROW) + ROWS_AT_ONCE + SPARE_ROWS);

  const scrolled = () => {
    const element = /** @type {HTMLDivElement} */ (scroller.current);
    setTop(ROWS_AT_ONCE * Math.floor(element.scrollTop / ROW / ROWS_AT_ONCE));
  };
  const move = (/** @type {number} */ to) => {
    const element = /** @type {HTMLDivElement} */ (scroller.current);
    const next = Math.min(Math.max(to, 0), rows.length - 1);
    setCurrent(next);
    const highest = next * ROW;
    const lowest = (next + 1) * ROW - (size.height - HEADER);
    if (element.scrollTop > highest) element.scrollTop = highest;
    else if (element.scrollTop < lowest) element.scrollTop = lowest;
  };
  const press = (/** @type {KeyboardEvent} */ event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || !rows.length) return;
    const page = Math.max(1, Math.floor((size.height - HEADER) / ROW) - 1);
    /** @type {Record<string, () => void>} */
    const keys = {
      ArrowDown: () => move(at + 1), ArrowUp: () => move(at - 1), PageDown: () => move(at + page), PageUp: () => move(at - page),
      Home: () => move(0), End: () => move(rows.length - 1), Enter: () => open(rows[at]), " ": () => check(rows[at]), Escape: close,
    };
    if (!(event.key in keys)) return;
    event.preventDefault();
    keys[event.key]();
  };
  const click = (/** @type {any} */ event) => {
    const number = event.target.closest("[data-row]")?.dataset.row;
    if (number === undefined) return;
    setCurrent(Number(number));
    if (event.target.closest("input")) check(rows[Number(number)]);
    else if (event.target.closest("button, canvas")) open(rows[Number(number)]);
  };
  const showNote = (/** @type {any} */ event) => {
    if (!note.current) return;
    const canvas = event.type === "mouseleave" ? null : event.target.closest("canvas");
    const row = canvas ? rows[Number(canvas.dataset.row)] : null;
    const column = canvas ? Math.floor((event.clientX - canvas.getBoundingClientRect().left) / cell) : -1;
    note.current.textContent = row && column >= 0 && column < columns.length ? describe(row, column) : "";
  };
  return html`<p class="soft note" ref=${note}></p>
    <div class=${`matrix${width > size.width ? " overflows" : ""}`} ref=${scroller} tabindex="0" role="grid" aria-label=${label} aria-rowcount=${rows.length + 1} aria-activedescendant=${rows.length ? `level-row-${at}` : null}
      onScroll=${scrolled} onClick=${click} onKeyDown=${press} onMouseMove=${showNote} onMouseLeave=${showNote} style=${{ height: `min(70vh, ${HEADER + rows.length * ROW + 18}px)` }}>
      <div class="matrix-head" role="row" aria-rowindex="1" style=${{ width: `${width}px` }}>
        <span class="name" role="columnheader" style=${{ width: `${nameWidth}px` }}>level</span>
        ${numbers.map((one, k) => html`<span key=${one.title} role="columnheader" title=${one.help} class=${lefts[k] === null ? "" : "stays"} style=${{ width: `${one.width}px`, left: lefts[k] === null ? null : `${lefts[k]}px` }}>${one.title}</span>`)}
        <span class="labels" style=${{ width: `${columns.length * cell}px` }}>${labelled.map((k) => html`<i key=${k} role="columnheader" style=${{ left: `${(k + 0.5) * cell}px` }}>${columns[k]}</i>`)}</span>
      </div>
      <div class="matrix-body" style=${{ width: `${width}px`, height: `${rows.length * ROW}px` }}>
        ${rows.slice(from, to).map((row, k) => {
          const isCurrent = from + k === at;
          return drawnRow(cache, row, [from + k, isCurrent, row.key === chosen, cell, nameWidth, lefts.join()], () => html`<${LevelRow} key=${row.key} row=${row} number=${from + k} isCurrent=${isCurrent} isChosen=${row.key === chosen} cell=${cell} nameWidth=${nameWidth} widths=${numbers} lefts=${lefts} />`);
        })}
      </div>
    </div>`;
}

/** A row as it was made before, which is not compared with anything, unless its state is another one.
 * @param {WeakMap<MatrixRow, { state: string, drawn: any }>} cache @param {MatrixRow} row @param {unknown[]} given @param {() => any} make */
function drawnRow(cache, row, given, make) {
  const state = given.join(" ");
  const known = cache.get(row);
  if (known?.state === state) return known.drawn;
  const drawn = make();
  cache.set(row, { state, drawn });
  return drawn;
}

/** @param {{ row: MatrixRow, number: number, isCurrent: boolean, isChosen: boolean, cell: number, nameWidth: number,
 *   widths: NumberColumn[], lefts: (number | null)[] }} props */
function LevelRow({ row, number, isCurrent, isChosen, cell, nameWidth, widths, lefts }) {
  return html`<div class=${`matrix-row${isCurrent ? " current" : ""}${isChosen ? " chosen" : ""}`} id=${`level-row-${number}`} role="row" aria-rowindex=${number + 2} aria-selected=${row.isChecked} data-row=${number}
      style=${{ top: `${number * ROW}px`, height: `${ROW}px` }}>
    <span class="name" role="gridcell" style=${{ width: `${nameWidth}px` }}><input type="checkbox" tabindex="-1" checked=${row.isChecked} aria-label=${`choose ${row.name}`} /><button class="link" tabindex="-1" title=${row.name}>${row.name}</button></span>
    ${row.numbers.map((text, k) => html`<span key=${k} role="gridcell" class=${`value${lefts[k] === null ? "" : " stays"}`} style=${{ width: `${widths[k].width}px`, left: lefts[k] === null ? null : `${lefts[k]}px` }}>${text}</span>`)}
    <${Strip} values=${row.values} cell=${cell} number=${number} />
  </div>`;
}

/** @param {{ values: (number | null)[], cell: number, number: number }} props */
function Strip({ values, cell, number }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  useEffect(() => {
    const draw = () => {
      const element = /** @type {HTMLCanvasElement} */ (canvas.current);
      const scale = devicePixelRatio || 1;
      element.width = values.length * cell * scale;
      element.height = ROW * scale;
      const context = /** @type {CanvasRenderingContext2D} */ (element.getContext("2d"));
      context.scale(scale, scale);
      drawStrip(context, values, cell);
    };
    draw();
    addEventListener("themechange", draw);
    return () => removeEventListener("themechange", draw);
  }, [values, cell]);
  return html`<canvas ref=${canvas} data-row=${number} aria-hidden="true" style=${{ width: `${values.length * cell}px`, height: `${ROW}px` }}></canvas>`;
}

/** @param {CanvasRenderingContext2D} context @param {(number | null)[]} values @param {number} cell */
function drawStrip(context, values, cell) {
  const empty = values.includes(null) ? colour("grid") : "";
  context.font = "11px sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  values.forEach((value, k) => {
    context.fillStyle = value === null ? empty : heat(value);
    context.fillRect(k * cell, 1, cell - 1, ROW - 2);
    if (value === null || cell < 30) return;
    context.fillStyle = value > 0.55 ? "#10202c" : "#f2f5f7";
    context.fillText(String(Math.round(100 * value)), (k + 0.5) * cell, ROW / 2);
  });
}

/** Columns with labels, as many as fit; those of `first` and the last one before others.
 * @param {string[]} columns @param {string[]} first @param {number} cell @returns {number[]} */
function labelledColumns(columns, first, cell) {
  const every = Math.max(1, Math.ceil(LABEL / cell));
  const wanted = [...columns.keys()].filter((k) => first.includes(columns[k]) || k === columns.length - 1).concat([...columns.keys()]);
  /** @type {number[]} */
  const taken = [];
  for (const k of wanted) if (taken.every((other) => Math.abs(other - k) >= every)) taken.push(k);
  return taken.sort((a, b) => a - b);
}

const PICTURE_NAMES = 200; // pixels of the names in a picture
const MAX_PICTURE_ROWS = 1000; // browsers draw at most some 30,000 pixels

/** All rows as one picture, for a file. @param {MatrixRow[]} rows @param {string[]} columns @returns {HTMLCanvasElement} */
export function matrixPicture(rows, columns) {
  const cell = Math.max(MIN_CELL, Math.min(MAX_CELL, Math.floor(900 / Math.max(columns.length, 1))));
  const shown = rows.slice(0, MAX_PICTURE_ROWS);
  const canvas = document.createElement("canvas");
  canvas.width = PICTURE_NAMES + columns.length * cell;
  canvas.height = HEADER + shown.length * ROW;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.fillStyle = colour("panel");
  context.fillRect(0, 0, canvas.width, canvas.height);
  const text = (/** @type {string} */ words, /** @type {number} */ x, /** @type {number} */ y, /** @type {CanvasTextAlign} */ align) => {
    context.font = "11px sans-serif";
    context.textBaseline = "middle";
    context.textAlign = align;
    context.fillStyle = colour("ink");
    context.fillText(words, x, y, PICTURE_NAMES - 12);
  };
  for (const k of labelledColumns(columns, [], cell)) text(columns[k], PICTURE_NAMES + (k + 0.5) * cell, HEADER / 2, "center");
  shown.forEach((row, k) => {
    text(row.name, PICTURE_NAMES - 8, HEADER + (k + 0.5) * ROW, "right");
    context.save();
    context.translate(PICTURE_NAMES, HEADER + k * ROW);
    drawStrip(context, row.values, cell);
    context.restore();
  });
  return canvas;
}
