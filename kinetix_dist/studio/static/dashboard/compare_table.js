// Table of compared runs: held-out solve rates of each set with counts and intervals, and gains over before and random.
import { addressOf, setQuery, useAddress } from "../base/address.js";
import { duration, percent, short } from "../base/format.js";
import { html } from "../base/html.js";
import { count } from "../base/language.js";
import { SortableTable, sorted, sortOf } from "../base/sortable_table.js";
import { Panel } from "../charts/panel.js";

const BEST_FIRST = "-now";
export const RATES = ["random", "before", "now", "best"];
export const GAINS = ["gain_before", "gain_random"];

/** @type {import("../base/sortable_table.js").Column[]} */
const COLUMNS = [
  { key: "run", title: "run", isLead: true, value: (row) => row.run, cell: (row) => html`<a href=${addressOf(["run", row.run, "overview"])}>${row.run}</a>` },
  { key: "curriculum", title: "curriculum", term: "curriculum", value: (row) => row.curriculum, cell: (row) => row.curriculum ?? "-" },
  { key: "set", title: "set", term: "evaluation set", value: (row) => row.set, cell: (row) => html`${row.set}${row.reason ? html`<div class="problem soft">${row.reason}</div>` : null}` },
  rateColumn("random", "random", "random actions"),
  rateColumn("before", "before", undefined, "the policy before training: what it began with"),
  rateColumn("now", "now", undefined, "the newest evaluation since training began"),
  rateColumn("best", "best", undefined, "the highest of these evaluations: chosen after the fact, so too high by selection"),
  gainColumn("gain_before", "gain over before"),
  gainColumn("gain_random", "gain over random"),
  { key: "env_steps", title: "env steps", isNumber: true, help: "at the newest evaluation, or so far where there is none", value: (row) => row.env_steps, cell: (row) => short(row.env_steps) },
  { key: "seconds", title: "time", isNumber: true, help: "training seconds at the newest evaluation, or so far where there is none", value: (row) => row.seconds, cell: (row) => duration(row.seconds) },
];

/** @param {string} key @param {string} title @param {string} [term] @param {string} [help] @returns {import("../base/sortable_table.js").Column} */
function rateColumn(key, title, term, help) {
  return { key, title, term, help, isNumber: true, value: (row) => row[key]?.rate, cell: (row) => {
    const rate = row[key];
    if (!rate) return "-";
    const when = rate.update === null ? "" : `, update ${rate.update}`;
    return html`<span title=${`${rate.solved} of ${count(rate.episodes, "episode")} solved${when}; 95 % interval ${percent(rate.low)} to ${percent(rate.high)}`}>${percent(rate.rate)}
      <span class="soft under">${percent(rate.low)} to ${percent(rate.high)}<br /><i>, </i>${rate.solved} of ${rate.episodes}</span></span>`;
  } };
}

/** @param {string} key @param {string} title @returns {import("../base/sortable_table.js").Column} */
function gainColumn(key, title) {
  return { key, title, term: "gain", isNumber: true, help: "percentage points, with the 95 % interval of the difference", value: (row) => row[key]?.difference, cell: (row) => {
    const gain = row[key];
    if (!gain) return "-";
    const sign = gain.low > 0 ? "good" : gain.high < 0 ? "bad" : "";
    return html`<span><b class=${sign}>${points(gain.difference)}</b> <span class="soft under">${points(gain.low)} to ${points(gain.high)}${sign ? "" : html`<br /><i>, </i>may be chance`}</span></span>`;
  } };
}

/** "+12.5", percentage points. @param {number} share */
function points(share) {
  const text = (100 * share).toFixed(1);
  return share > 0 && text !== "0.0" ? `+${text}` : text === "-0.0" ? "0.0" : text;
}

/** @param {{ rows: any[] }} props */
export function CompareTable({ rows }) {
  const { query } = useAddress();
  const sort = sortOf(query.get("sort"), COLUMNS, BEST_FIRST);
  const values = (/** @type {any} */ row) => [row.run, row.curriculum, row.seed, row.set,
    ...RATES.flatMap((name) => ["rate", "low", "high", "solved", "episodes", "update"].map((field) => row[name]?.[field])),
    ...GAINS.flatMap((name) => ["difference", "low", "high"].map((field) => row[name]?.[field])),
    row.env_steps, row.seconds, row.evaluations, row.reason];
  const heads = ["run", "curriculum", "seed", "set",
    ...RATES.flatMap((name) => ["rate", "low", "high", "solved", "episodes", "update"].map((field) => `${name}_${field}`)),
    ...GAINS.flatMap((name) => ["difference", "low", "high"].map((field) => `${name}_${field}`)), "env_steps", "seconds", "evaluations", "reason"];
  return html`<${Panel} title="Held-out solve rates: runs" name="compared runs" wide=${true} picture=${false} help="rates with 95 % intervals and solved of all episodes; gains in percentage points with the interval of the difference"
    rows=${() => [heads, ...sorted(rows, COLUMNS, sort).map(values)]}>
    <${SortableTable} name="compared" label="compared runs" columns=${COLUMNS} rows=${rows} rowKey=${(/** @type {any} */ row) => `${row.run} ${row.set}`}
      sort=${sort} choose=${(/** @type {string} */ chosen) => setQuery({ sort: chosen })} />
  </${Panel}>`;
}
