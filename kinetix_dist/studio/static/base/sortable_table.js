// A table that its headers sort: a click, or Enter on one. On a phone its rows are cards, and a field above sorts them.
import { html } from "./html.js";
import { Term } from "./term.js";

/**
 * `value`: by which rows are sorted, empty ones (null) last; without it a column sorts nothing. `term`: of the glossary,
 * with the meaning of the column. `isLead`: the heading of a card.
 * @typedef {{ key: string, title: string, cell: (row: any) => any, value?: (row: any) => string | number | null | undefined,
 *   isNumber?: boolean, help?: string, term?: string, isLead?: boolean }} Column
 * @typedef {{ key: string, isDown: boolean }} Sort
 */

/** "-now": down by column `now`. What is none of the columns is the first choice of the page.
 * @param {string | null} text @param {Column[]} columns @param {string} first @returns {Sort} */
export function sortOf(text, columns, first) {
  const has = (/** @type {string} */ given) => columns.some((column) => column.value && column.key === given.replace(/^-/, ""));
  const chosen = text && has(text) ? text : first;
  return { key: chosen.replace(/^-/, ""), isDown: chosen.startsWith("-") };
}

/** @param {any[]} rows @param {Column[]} columns @param {Sort} sort */
export function sorted(rows, columns, { key, isDown }) {
  const value = columns.find((column) => column.key === key)?.value;
  if (!value) return rows;
  const isEmpty = (/** @type {any} */ one) => one === null || one === undefined || Number.isNaN(one);
  return rows.map((row) => ({ row, by: value(row) })).sort((a, b) => {
    if (isEmpty(a.by) || isEmpty(b.by)) return Number(isEmpty(a.by)) - Number(isEmpty(b.by));
    const order = typeof a.by === "number" && typeof b.by === "number" ? a.by - b.by : String(a.by).localeCompare(String(b.by), "en", { numeric: true });
    return isDown ? -order : order;
  }).map(({ row }) => row);
}

/**
 * `choose` gets the new order as it stands in an address.
 * @param {{ columns: Column[], rows: any[], rowKey: (row: any) => string, sort: Sort, choose: (sort: string) => void, name: string,
 *   label: string }} props
 */
export function SortableTable({ columns, rows, rowKey, sort, choose, name, label }) {
  const order = (/** @type {Column} */ { key, isNumber }) => (sort.key === key ? `${sort.isDown ? "" : "-"}${key}` : `${isNumber ? "-" : ""}${key}`);
  const current = `${sort.isDown ? "-" : ""}${sort.key}`;
  return html`<label class="sort-field">sort by <select aria-label=${`sort ${label}`} onChange=${(/** @type {any} */ e) => choose(e.target.value)}>
      ${columns.filter((column) => column.value).flatMap(({ key, title }) => [["-", "down"], ["", "up"]].map(([sign, way]) => html`<option key=${sign + key} value=${sign + key} selected=${sign + key === current}>${title}, ${way}</option>`))}
    </select></label>
    <div class="scroll"><table class=${`sortable ${name}`} role="table" aria-label=${label}><thead role="rowgroup"><tr role="row">${columns.map((column) => {
      const isSorted = column.value && column.key === sort.key;
      return html`<th key=${column.key} role="columnheader" class=${column.isNumber ? "number" : ""} title=${column.help} aria-sort=${isSorted ? (sort.isDown ? "descending" : "ascending") : column.value ? "none" : null}>
        ${column.value ? html`<button class="sort" onClick=${() => choose(order(column))}>${column.title}<span aria-hidden="true">${isSorted ? (sort.isDown ? " ▼" : " ▲") : " ↕"}</span></button>` : column.title}
        ${column.term ? html` <${Term} name=${column.term}><span aria-label=${`meaning of ${column.term}`}>?</span></${Term}>` : null}</th>`;
    })}</tr></thead>
    <tbody role="rowgroup">${sorted(rows, columns, sort).map((row) => html`<tr key=${rowKey(row)} role="row">${columns.map((column) => html`<td key=${column.key} role="cell" data-label=${column.title}
      class=${`${column.isNumber ? "number" : ""}${column.isLead ? " lead" : ""}`}><div>${column.cell(row)}</div></td>`)}</tr>`)}</tbody></table></div>`;
}
