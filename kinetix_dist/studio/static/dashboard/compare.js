// Several runs: one metric over a shared axis, groups by a field of the config with bands, what differs between configs.
import { setQuery, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { smooth } from "../base/format.js";
import { html } from "../base/html.js";
import { LineChart } from "../charts/line_chart.js";
import { Panel } from "../charts/panel.js";
import { Notes } from "./parts.js";
import { useView, ViewBar, zoom } from "./view.js";

const DEFAULT_METRIC = "train/solve_rate";

export function ComparePage() {
  const { query } = useAddress();
  const view = useView();
  const chosen = query.get("runs") ?? "";
  const metric = query.get("metric") ?? DEFAULT_METRIC;
  const group = query.get("group") ?? "";
  const statistic = query.get("statistic") ?? "mean";
  const all = useRequest(() => get("runs"), []);
  const { data, error } = useRequest(
    () => (chosen ? get("compare", { runs: chosen, metric, x: view.axis, group, statistic }) : Promise.resolve(null)),
    [chosen, metric, view.axis, group, statistic],
  );
  const runs = chosen.split(",").filter(Boolean);
  const toggle = (/** @type {string} */ id) =>
    setQuery({ runs: (runs.includes(id) ? runs.filter((other) => other !== id) : [...runs, id]).join(",") });
  return html`<main>
    <${Notes} notes=${[all.error, error, ...(data?.problems ?? [])].filter(Boolean)} />
    <details open=${!runs.length}><summary>${runs.length} runs are compared</summary><div class="row">
      ${(all.data?.runs ?? []).map((/** @type {any} */ run) => html`<label key=${run.id}><input type="checkbox" checked=${runs.includes(run.id)} onChange=${() => toggle(run.id)} /> ${run.id}</label>`)}
    </div></details>
    <${ViewBar} view=${view}>
      <label>metric <${Select} name="metric" value=${metric} options=${data?.metrics ?? [metric]} /></label>
      <label>group by <${Select} name="group" value=${group} options=${["", ...(data?.fields ?? [])]} first=${Object.keys(data?.differences ?? {})} empty="(no groups: all runs)" /></label>
      <label>statistic <${Select} name="statistic" value=${statistic} options=${["mean", "iqm"]} /></label>
    </${ViewBar}>
    ${data ? html`<div class="columns">
      <${Overlay} data=${data} metric=${metric} view=${view} />
      <${Groups} data=${data} metric=${metric} view=${view} statistic=${statistic} group=${group} />
    </div><${Differences} data=${data} runs=${runs} />` : html`<p class="missing">${runs.length ? "reading ..." : "Choose runs to compare."}</p>`}
  </main>`;
}

/** @param {{ name: string, value: string, options: string[], first?: string[], empty?: string }} props */
function Select({ name, value, options, first = [], empty }) {
  const ordered = [...new Set(["", ...first, ...options])].filter((option) => options.includes(option) || option === value);
  const shown = ordered.includes(value) ? ordered : [value, ...ordered];
  return html`<select onChange=${(/** @type {any} */ e) => setQuery({ [name]: e.target.value })}>
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

/** @param {{ data: any, metric: string, view: any }} props */
function Overlay({ data, metric, view }) {
  const names = Object.keys(data.runs);
  const { x, columns } = joined(names.map((name) => ({ x: data.runs[name].x, columns: [smooth(data.runs[name].mean, view.smooth)] })));
  const lines = names.map((name, k) => ({ label: name, values: columns[k][0] }));
  const rows = () => [["run", data.axis, metric], ...names.flatMap((name) => data.runs[name].x.map((/** @type {number} */ place, /** @type {number} */ k) => [name, place, data.runs[name].mean[k]]))];
  return html`<${Panel} title=${`${metric}: each run`} rows=${rows} missing=${names.length ? null : `None of these runs has ${metric}.`}>
    <${LineChart} x=${x} lines=${lines} axis=${data.unit} height=${320} range=${[view.from, view.to]} onZoom=${zoom} /></${Panel}>`;
}

/** @param {{ data: any, metric: string, view: any, statistic: string, group: string }} props */
function Groups({ data, metric, view, statistic, group }) {
  const groups = data.groups.filter((/** @type {any} */ entry) => entry.x.length);
  const { x, columns } = joined(groups.map((/** @type {any} */ entry) => ({ x: entry.x, columns: [smooth(entry.center, view.smooth), entry.low, entry.high] })));
  const lines = groups.map((/** @type {any} */ entry, /** @type {number} */ k) => ({
    label: `${group ? `${group.split(".").at(-1)} = ` : ""}${entry.value} (${entry.runs.length} ${entry.runs.length === 1 ? "run" : "runs"})`,
    values: columns[k][0], low: columns[k][1], high: columns[k][2],
  }));
  const rows = () => [["group", data.axis, statistic, "low", "high", "runs"], ...groups.flatMap((/** @type {any} */ entry) =>
    entry.x.map((/** @type {number} */ place, /** @type {number} */ k) => [entry.value, place, entry.center[k], entry.low[k], entry.high[k], entry.num_runs[k]]))];
  const name = statistic === "iqm" ? "interquartile mean" : "mean";
  return html`<${Panel} title=${`${metric}: ${name} of groups`} help="bands: 95 % bootstrap over runs; none where one run has data" rows=${rows}
    missing=${groups.length ? null : "There is nothing to put together."}>
    <${LineChart} x=${x} lines=${lines} axis=${data.unit} height=${320} range=${[view.from, view.to]} onZoom=${zoom} /></${Panel}>`;
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
