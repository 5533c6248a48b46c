// One level of an evaluation set: its picture, played in place, and its history over evaluations with intervals.
import { get, useRequest } from "../base/api.js";
import { percent } from "../base/format.js";
import { html } from "../base/html.js";
import { LineChart } from "../charts/line_chart.js";
import { labelOf } from "./evaluated_levels.js";
import { featureText, LevelPanel } from "./level_panel.js";

/** @typedef {import("./evaluated_levels.js").Row} Row */

/** @param {{ run: string, row: Row, columns: import("./evaluated_levels.js").Column[], size: string | null, problem: string | null }} props
 * size: of the set's levels, and `problem`: why they are not known; both null: not yet */
export function EvaluatedLevel({ run, row, columns, size, problem }) {
  const set = `runs/${encodeURIComponent(run)}/evaluations`;
  const fields = { set: row.set, index: String(row.index), name: row.name };
  const picture = useRequest(() => (size ? get(`${set}/thumbnails`, { set: row.set, indices: row.index }) : Promise.resolve([])), [run, row.set, row.index, size]);
  const drawn = picture.data?.find((/** @type {any} */ entry) => entry.index === row.index);
  const given = { run, ...fields, index: row.index };
  /** @type {[string, any][]} */
  const facts = [["set", row.set], ["now", countsText(row.now)]];
  if (row.before) facts.push(["at first", countsText(row.before)]);
  for (const [kind, words] of /** @type {["last" | "first" | "best", string][]} */ ([["last", "the last evaluation"], ["first", "the first"], ["best", "the best"]])) {
    if (row.changes) facts.push([`since ${words} (${row.changes[kind].from})`, changeText(row.changes[kind])]);
  }
  const { distance, ...counts } = row.features ?? {};
  const features = row.features ? `${featureText(counts)}, green to blue ${distance.toFixed(2)} m at the start, from centre to centre` : "";
  return html`<${LevelPanel} title=${row.name} run=${run} given=${given} subject=${`${run} ${row.set} ${row.index}`} label=${`level ${row.name}; keys play it`} picture=${drawn}
      missing=${problem ?? picture.error ?? "the engine builds the set: seconds the first time ..."} facts=${facts} features=${features} document=${`${set}/document?${new URLSearchParams(fields)}`}>
    <${History} row=${row} columns=${columns} />
  </${LevelPanel}>`;
}

/** @param {{ row: Row, columns: import("./evaluated_levels.js").Column[] }} props */
function History({ row, columns }) {
  const played = [...columns.keys()].filter((k) => row.cells[k]);
  const ofPolicy = played.filter((k) => columns[k].phase !== "random_policy");
  const of = (/** @type {"rate" | "low" | "high"} */ field) => ofPolicy.map((k) => row.cells[k]?.[field] ?? null);
  return html`<section data-panel="history"><h3>History over evaluations</h3>
    ${ofPolicy.length > 1 ? html`<${LineChart} x=${ofPolicy.map((k) => columns[k].update)} lines=${[{ label: "solved, 95 % interval", values: of("rate"), low: of("low"), high: of("high") }]} axis="updates" height=${130} />` : null}
    <div class="scroll short"><table class="tight"><tbody>${[...played].reverse().map((k) => html`<tr key=${`${columns[k].phase} ${columns[k].update}`}><td>${columns[k].phase === "random_policy" ? "random actions" : `update ${columns[k].update}${columns[k].phase === "training" ? "" : `, ${labelOf(columns[k])}`}`}</td><td class="number">${countsText(row.cells[k])}</td></tr>`)}</tbody></table></div>
  </section>`;
}

/** @param {import("./evaluated_levels.js").Counts | null} counts */
export function countsText(counts) {
  return counts ? `${percent(counts.rate)} (${counts.solved} of ${counts.attempts}), 95 % ${percent(counts.low)} to ${percent(counts.high)}` : "not played";
}

/** @param {import("./evaluated_levels.js").Change} change */
function changeText({ value, low, high }) {
  return `${points(value)} points, 95 % ${points(low)} to ${points(high)}`;
}

/** A difference of shares in percentage points, signed. @param {number} value */
export function points(value) {
  const text = (100 * Math.abs(value)).toFixed(0);
  return text === "0" ? "0" : `${value < 0 ? "−" : "+"}${text}`;
}
