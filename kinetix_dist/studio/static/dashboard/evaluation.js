// Each level of the evaluation sets over time: how often it was solved, as a heat map and a table.
import { get, useRequest } from "../base/api.js";
import { interval, percent, rateWithCount } from "../base/format.js";
import { html, useState } from "../base/html.js";
import { HeatMap } from "../charts/heat_map.js";
import { Panel } from "../charts/panel.js";
import { Notes } from "./parts.js";
import { useRunChanges } from "./run_changes.js";

const MAX_ROWS = 120;
/** @type {Record<string, string>} */
const PHASES = { random_policy: "random", before: "before", training: "", after: "after" };

/** @param {{ run: string }} props */
export function EvaluationPage({ run }) {
  const changes = useRunChanges(run);
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/evaluations`), [run, changes]);
  const [order, setOrder] = useState("name");
  const notes = [...(error ? [error] : []), ...(data?.problems ?? [])];
  if (!data) return html`<main><${Notes} notes=${notes} /></main>`;
  const sets = Object.entries(data.sets);
  return html`<main>
    <${Notes} notes=${notes} />
    ${sets.length ? null : html`<p class="missing">No evaluation so far (evaluations.jsonl). Runs evaluate before and after training, and every evaluation.every updates.</p>`}
    ${data.without_levels && sets.length ? html`<p class="missing">This run has no evaluations.jsonl (an older version): rates of whole sets, without levels.</p>` : null}
    <div class="row"><label>order of levels <select onChange=${(/** @type {any} */ e) => setOrder(e.target.value)}>
      <option value="name">by name</option><option value="rate">most solved last first</option><option value="gain">most gained first</option></select></label></div>
    ${sets.map(([name, set]) => html`<${Set} key=${name} run=${run} name=${name} set=${set} order=${order} />`)}
  </main>`;
}

/** @param {{ run: string, name: string, set: any, order: string }} props */
function Set({ run, name, set, order }) {
  const points = set.points;
  const columns = points.map((/** @type {any} */ p) => PHASES[p.phase] || String(p.update));
  const rows = () => [["set", "phase", "update", "env_steps", "level", "solved", "attempts"],
    ...points.flatMap((/** @type {any} */ p) => (p.solved ? p.solved.map((/** @type {number} */ count, /** @type {number} */ k) => [name, p.phase, p.update, p.env_steps, set.names[k], count, p.attempts]) : [[name, p.phase, p.update, p.env_steps, "", null, p.episodes]]))];
  const table = html`<div class="scroll"><table><thead><tr><th></th>${columns.map((/** @type {string} */ column, /** @type {number} */ k) => html`<th key=${k} class="number">${column}</th>`)}</tr></thead>
    <tbody><tr><td>${name}</td>${points.map((/** @type {any} */ p, /** @type {number} */ k) => html`<td key=${k} class="number" title=${`95 % interval ${percent(interval(p).low)} to ${percent(interval(p).high)}`}>${percent(p.rate)} of ${p.episodes}</td>`)}</tr></tbody></table></div>`;
  if (!set.names) return html`<${Panel} title=${name} rows=${rows} name=${`${run} ${name}`} picture=${false} wide=${true}>${table}</${Panel}>`;
  const rate = (/** @type {any} */ p, /** @type {number} */ level) => (p && p.attempts ? p.solved[level] / p.attempts : 0);
  const first = points.find((/** @type {any} */ p) => p.phase === "before") ?? points[0];
  const last = points.at(-1);
  const levels = [...set.names.keys()];
  if (order === "rate") levels.sort((a, b) => rate(last, b) - rate(last, a));
  if (order === "gain") levels.sort((a, b) => rate(last, b) - rate(first, b) - rate(last, a) + rate(first, a));
  if (order === "name") levels.sort((a, b) => set.names[a].localeCompare(set.names[b], "en", { numeric: true }));
  const shown = levels.slice(0, MAX_ROWS);
  const values = shown.map((level) => points.map((/** @type {any} */ p) => (p.attempts ? p.solved[level] / p.attempts : null)));
  const texts = shown.map((level) => points.map((/** @type {any} */ p, /** @type {number} */ k) => `${set.names[level]}, ${columns[k]}: ${rateWithCount(p.solved[level], p.attempts)}`));
  return html`<${Panel} title=${`${name}: share of attempts solved, a row a level`} help=${`${set.names.length} levels, ${last.attempts} attempts each; a column an evaluation (update)`} rows=${rows} name=${`${run} ${name}`} wide=${true}>
    ${table}
    <${HeatMap} rows=${shown.map((level) => set.names[level])} columns=${columns} values=${values} texts=${texts} labelWidth=${170} describe=${`solved attempts of the levels of ${name}`} />
    ${levels.length > shown.length ? html`<p class="soft">the first ${shown.length} of ${levels.length} levels in this order; the CSV has all</p>` : null}
  </${Panel}>`;
}
