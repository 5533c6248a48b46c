// Several runs: held-out solve rates or other metrics over a shared axis, groups by a field of the config with bands, a
// table of rates and gains, what differs between configs.
import { setQuery, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { percent } from "../base/format.js";
import { html } from "../base/html.js";
import { count } from "../base/language.js";
import { Term } from "../base/term.js";
import { LineChart } from "../charts/line_chart.js";
import { Panel } from "../charts/panel.js";
import { CompareTable, GAINS, RATES } from "./compare_table.js";
import { Notes } from "./parts.js";
import { useView, ViewBar, zoom } from "./view.js";

const HELD_OUT = "held-out solve rates";
const BASELINE_STYLE = 6; // grey and dotted
const FIRST_RUNS = 6; // that are chosen where the address names none

export function ComparePage() {
  const { query } = useAddress();
  const view = useView();
  const all = useRequest(() => get("runs"), []);
  const chosen = query.get("runs") ?? newestRuns(all.data?.runs ?? []).join(",");
  const metric = query.get("metric") ?? "";
  const sets = (query.get("sets") ?? "").split(",").filter(Boolean);
  const group = query.get("group") ?? "";
  const statistic = query.get("statistic") ?? "mean";
  const wanted = metric || sets.map(metricOf).join(",");
  const { data, error } = useRequest(
    () => (chosen ? get("compare", { runs: chosen, metric: wanted, x: view.axis, group, statistic }) : Promise.resolve(null)),
    [chosen, wanted, view.axis, group, statistic],
  );
  const runs = chosen.split(",").filter(Boolean);
  const toggle = (/** @type {string} */ id) =>
    setQuery({ runs: (runs.includes(id) ? runs.filter((other) => other !== id) : [...runs, id]).join(",") });
  const shared = { data, view, runs };
  return html`<main>
    <${Notes} notes=${[all.error, error, ...(data?.problems ?? [])].filter(Boolean)} />
    <details open=${!runs.length}><summary>${count(runs.length, "run is", "runs are")} compared</summary><div class="row">
      ${(all.data?.runs ?? []).map((/** @type {any} */ run) => html`<label key=${run.id}><input type="checkbox" checked=${runs.includes(run.id)} onChange=${() => toggle(run.id)} /> ${run.id}</label>`)}
    </div></details>
    <${ViewBar} view=${view}>
      <label>metric <${Select} name="metric" value=${metric} options=${["", ...(data?.metrics ?? [])]} empty=${HELD_OUT} /></label>
      <label>group by <${Select} name="group" value=${group} options=${["", ...(data?.fields ?? [])]} first=${Object.keys(data?.differences ?? {})} empty="(no groups: all runs)" /></label>
      <label>statistic <${Select} name="statistic" value=${statistic} options=${["mean", "iqm"]} /></label>
    </${ViewBar}>
    ${data && data.sets.length ? html`<${Sets} all=${data.sets} chosen=${sets} />` : null}
    ${data ? html`<div class="grid two">
      ${Object.entries(data.curves).map(([name, curves]) => html`<${Overlay} key=${`runs ${name}`} ...${shared} metric=${name} curves=${curves} />
        <${Groups} key=${`groups ${name}`} ...${shared} metric=${name} curves=${curves} statistic=${statistic} group=${group} />`)}
    </div>
    <${CompareTable} rows=${rowsOf(data.rows, sets)} />
    <${Differences} data=${data} runs=${runs} />` : html`<p class="missing">${runs.length ? "reading ..." : "Choose runs to compare."}</p>`}
  </main>`;
}

/** Runs that are compared where the address names none: those that were written last. @param {any[]} runs */
function newestRuns(runs) {
  const known = runs.filter((run) => Object.keys(run.evaluated).length);
  return (known.length ? known : runs).toSorted((a, b) => (b.modified ?? 0) - (a.modified ?? 0)).slice(0, FIRST_RUNS).map((run) => run.id).toSorted();
}

/** @param {string} set */
const metricOf = (set) => `evaluation/${set}/solve_rate`;

/** The evaluation set of a metric; null where it is of none. @param {string} metric */
const setOf = (metric) => metric.match(/^evaluation\/(.+)\/solve_rate$/)?.[1] ?? null;

/** Rows of the chosen sets; a run that has none of these has one without rates. @param {any[]} rows @param {string[]} sets */
function rowsOf(rows, sets) {
  if (!sets.length) return rows;
  const shown = rows.filter((row) => !row.set || sets.includes(row.set));
  const others = rows.filter((row) => !shown.some((one) => one.run === row.run));
  const left = others.filter((row, k) => others.findIndex((one) => one.run === row.run) === k);
  const empty = Object.fromEntries([...RATES, ...GAINS].map((name) => [name, null]));
  return [...shown, ...left.map((row) => ({ ...row, ...empty, set: null, evaluations: 0, reason: `not evaluated on ${sets.join(", ")}` }))];
}

/** Evaluation sets that charts and table show; none chosen: all. @param {{ all: string[], chosen: string[] }} props */
function Sets({ all, chosen }) {
  const shown = chosen.length ? chosen : all;
  const toggle = (/** @type {string} */ name) => {
    const next = all.filter((other) => (other === name ? !shown.includes(name) : shown.includes(other)));
    setQuery({ sets: next.length === all.length ? null : next.join(","), metric: null });
  };
  return html`<div class="row" role="group" aria-label="evaluation sets"><${Term} name="evaluation set">evaluation sets</${Term}>
    ${all.map((name) => html`<label key=${name}><input type="checkbox" checked=${shown.includes(name)} onChange=${() => toggle(name)} /> ${name}</label>`)}</div>`;
}

/** @param {{ name: string, value: string, options: string[], first?: string[], empty?: string }} props */
function Select({ name, value, options, first = [], empty }) {
  const ordered = [...new Set(["", ...first, ...options])].filter((option) => options.includes(option) || option === value);
  const shown = ordered.includes(value) ? ordered : [value, ...ordered];
  return html`<select aria-label=${name} onChange=${(/** @type {any} */ e) => setQuery({ [name]: e.target.value })}>
    ${shown.map((option) => html`<option key=${option} value=${option} selected=${option === value}>${option || empty}</option>`)}</select>`;
}

/** Curves with places of their own on one axis: every place of any, with gaps bridged.
 * @param {{ x: number[], columns: (number | null)[][] }[]} curves */
function joined(curves) {
  const x = [...new Set(curves.flatMap((curve) => curve.x))].sort((a, b) => a - b);
  const index = new Map(x.map((value, k) => [value, k]));
  const columns = curves.map((curve) => curve.columns.map((values) => {
    const column = /** @type {(number | null | undefined)[]} */ (Array(x.length).fill(undefined));
    curve.x.forEach((place, k) => (column[/** @type {number} */ (index.get(place))] = values[k]));
    return /** @type {(number | null)[]} */ (column);
  }));
  return { x, columns };
}

/** Random actions as lines over the whole axis, with their counts. @param {any} curves @param {number[]} x */
function baselinesOf(curves, x) {
  const several = curves.baselines.length > 1;
  return curves.baselines.map((/** @type {any} */ one, /** @type {number} */ k) => ({
    label: `random actions ${percent(one.rate)} (${one.solved} of ${one.episodes})${several ? ` of ${one.runs.join(", ")}` : ""}`,
    values: x.map(() => one.rate), style: BASELINE_STYLE * (k + 1),
  }));
}

/** Runs that a chart leaves out, each with its reason. @param {{ curves: any }} props */
function LeftOut({ curves }) {
  const text = reasonsOf(curves);
  return text ? html`<p class="soft">left out: ${text}</p>` : null;
}

/** "a, b (no evaluation so far); c (not evaluated on m)" @param {any} curves */
function reasonsOf(curves) {
  /** @type {Map<string, string[]>} */
  const runs = new Map();
  for (const [run, reason] of Object.entries(curves.missing)) runs.set(reason, [...(runs.get(reason) ?? []), run]);
  return [...runs].map(([reason, names]) => `${names.join(", ")} (${reason})`).join("; ");
}

/** Title of the charts of a metric. @param {string} metric */
const titleOf = (metric) => setOf(metric) ?? metric;

/** @param {any} curves @param {string} metric */
function nothing(curves, metric) {
  return `None of these runs has ${setOf(metric) ? `an evaluation on ${setOf(metric)}` : metric}: ${reasonsOf(curves)}.`;
}

/** @param {{ data: any, curves: any, metric: string, view: any, runs: string[] }} props */
function Overlay({ data, curves, metric, view, runs }) {
  const names = Object.keys(curves.runs);
  const isRate = setOf(metric) !== null;
  const { x, columns } = joined(names.map((name) => {
    const { x, mean, low, high } = curves.runs[name];
    return { x, columns: isRate ? [mean, low, high] : [mean] };
  }));
  const lines = names.map((name, k) => ({ label: name, values: columns[k][0], low: columns[k][1], high: columns[k][2], style: runs.indexOf(name), isMeasured: isRate }));
  const rows = () => [["run", data.axis, metric, ...(isRate ? ["low", "high", "episodes"] : [])], ...names.flatMap((name) => {
    const { x, mean, low, high, episodes } = curves.runs[name];
    return x.map((/** @type {number} */ place, /** @type {number} */ k) => [name, place, mean[k], ...(isRate ? [low[k], high[k], episodes[k]] : [])]);
  })];
  return html`<${Panel} title=${`${titleOf(metric)}: each run`} rows=${rows} missing=${names.length ? null : nothing(curves, metric)}
    help=${isRate ? "held-out solve rate (share) before training and as evaluated since; a point for each evaluation, with its 95 % interval; random actions as a dotted line" : undefined}>
    <${LineChart} x=${x} lines=${[...lines, ...baselinesOf(curves, x)]} axis=${data.unit} smoothing=${isRate ? 0 : view.smooth} height=${320} range=${[view.from, view.to]} onZoom=${zoom} />
    <${LeftOut} curves=${curves} /></${Panel}>`;
}

/** @param {{ data: any, curves: any, metric: string, view: any, statistic: string, group: string }} props */
function Groups({ data, curves, metric, view, statistic, group }) {
  const groups = curves.groups.filter((/** @type {any} */ entry) => entry.x.length);
  const isRate = setOf(metric) !== null;
  const { x, columns } = joined(groups.map((/** @type {any} */ entry) => ({ x: entry.x, columns: [entry.center, entry.low, entry.high] })));
  const lines = groups.map((/** @type {any} */ entry, /** @type {number} */ k) => {
    const members = entry.runs.filter((/** @type {string} */ run) => run in curves.runs);
    return { label: `${group ? `${group.split(".").at(-1)} = ` : ""}${entry.value} (${count(members.length, "run")})`, values: columns[k][0], low: columns[k][1], high: columns[k][2] };
  });
  const rows = () => [["group", data.axis, statistic, "low", "high", "runs"], ...groups.flatMap((/** @type {any} */ entry) =>
    entry.x.map((/** @type {number} */ place, /** @type {number} */ k) => [entry.value, place, entry.center[k], entry.low[k], entry.high[k], entry.num_runs[k]]))];
  const name = statistic === "iqm" ? "interquartile mean" : "mean";
  return html`<${Panel} title=${`${titleOf(metric)}: ${name} of groups`} help="bands: 95 % bootstrap over runs (seeds); none where one run has data, or all runs agree" rows=${rows}
    missing=${groups.length ? null : "There is nothing to put together."}>
    <${LineChart} x=${x} lines=${[...lines, ...baselinesOf(curves, x)]} axis=${data.unit} smoothing=${isRate ? 0 : view.smooth} height=${320} range=${[view.from, view.to]} onZoom=${zoom} /></${Panel}>`;
}

/** @param {{ data: any, runs: string[] }} props */
function Differences({ data, runs }) {
  const fields = Object.entries(data.differences);
  const rows = () => [["field", ...runs], ...fields.map(([field, values]) => [field, ...runs.map((run) => JSON.stringify(values[run]))])];
  return html`<${Panel} title="Where the configurations differ" help="click a field to group by it" rows=${rows} picture=${false} wide=${true}>
    ${fields.length ? html`<div class="scroll"><table><thead><tr><th>field</th>${runs.map((run) => html`<th key=${run}>${run}</th>`)}</tr></thead>
      <tbody>${fields.map(([field, values]) => html`<tr key=${field}><td><button class="link" onClick=${() => setQuery({ group: field })}>${field}</button></td>
        ${runs.map((run) => html`<td key=${run}>${values[run] === null ? "-" : JSON.stringify(values[run])}</td>`)}</tr>`)}</tbody></table></div>`
      : html`<p class="missing">${runs.length > 1 ? "All fields are equal." : "One run alone differs from none."}</p>`}
  </${Panel}>`;
}
