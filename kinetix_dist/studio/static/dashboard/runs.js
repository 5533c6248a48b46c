// Table of runs with state, progress and solve rates; chosen ones go to the comparison.
import { addressOf, setQuery, useAddress } from "../base/address.js";
import { get } from "../base/api.js";
import { interval, percent, short } from "../base/format.js";
import { html, useEffect, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { SortableTable, sortOf } from "../base/sortable_table.js";
import { Notes, State } from "./parts.js";
import { Mark } from "./verdict.js";

const REFRESH_MS = 5000;
const JUDGED_MS = 1000; // while runs are judged that have no verdict yet
const NEWEST_FIRST = "-state";

export function RunsPage() {
  const { query } = useAddress();
  const [answer, setAnswer] = useState(/** @type {any} */ (null));
  const [error, setError] = useState(/** @type {string | null} */ (null));
  const [chosen, setChosen] = useState(/** @type {string[]} */ ([]));
  const [filter, setFilter] = useState("");
  useEffect(() => {
    let isHere = true;
    /** @type {ReturnType<typeof setTimeout> | undefined} */
    let timer;
    const load = async () => {
      let wait = REFRESH_MS;
      if (!document.hidden) {
        try {
          const found = await get("runs");
          if (!isHere) return;
          if (found.runs.some((/** @type {any} */ run) => !run.verdict)) wait = JUDGED_MS;
          setAnswer(found);
          setError(null);
        } catch (problem) {
          if (!isHere) return;
          setError(/** @type {Error} */ (problem).message);
        }
      }
      timer = setTimeout(load, wait);
    };
    load();
    return () => {
      isHere = false;
      clearTimeout(timer);
    };
  }, []);
  if (!answer) return html`<${Notes} notes=${error ? [error] : []} /><p class="missing">${error ? "" : "reading runs ..."}</p>`;
  const rows = answer.runs.filter((/** @type {any} */ run) => `${run.id} ${run.name} ${run.status.state}`.includes(filter));
  const choose = (/** @type {string} */ id) =>
    setChosen(chosen.includes(id) ? chosen.filter((other) => other !== id) : [...chosen, id]);
  const columns = columnsOf(chosen, choose);
  return html`<main>
    <${Notes} notes=${[...(error ? [error] : []), ...answer.problems]} />
    <div class="row">
      <input placeholder="filter by name or state" value=${filter} onInput=${(/** @type {any} */ e) => setFilter(e.target.value)} aria-label="filter runs" />
      <a class=${`button${chosen.length < 2 ? " off" : ""}`} href=${chosen.length < 2 ? undefined : addressOf(["compare"], new URLSearchParams({ runs: chosen.join(",") }))}>
        compare ${chosen.length || ""}</a>
      <span class="soft">${rows.length === answer.runs.length ? count(rows.length, "run") : `${rows.length} of ${count(answer.runs.length, "run")}`}</span>
    </div>
    ${answer.runs.length ? html`<${SortableTable} name="runs" label="runs" columns=${columns} rows=${rows} rowKey=${(/** @type {any} */ run) => run.id}
        sort=${sortOf(query.get("sort"), columns, NEWEST_FIRST)} choose=${(/** @type {string} */ sort) => setQuery({ sort })} />`
      : html`<p class="missing">There are no runs here yet; one that starts appears by itself.</p>`}
  </main>`;
}

/** @param {string[]} chosen @param {(id: string) => void} choose @returns {import("../base/sortable_table.js").Column[]} */
function columnsOf(chosen, choose) {
  const last = (/** @type {string} */ name) => (/** @type {any} */ run) => run.last?.[name];
  return [
    { key: "run", title: "run", isLead: true, value: (run) => run.id, cell: (run) => html`<label class="choice"><input type="checkbox" checked=${chosen.includes(run.id)} onChange=${() => choose(run.id)} aria-label=${`compare ${run.id}`} /></label>
      <a href=${addressOf(["run", run.id, "overview"])} title=${run.path}>${run.id}</a>
      ${run.problems.map((/** @type {string} */ problem) => html`<div key=${problem} class="bad problem">${problem}</div>`)}` },
    { key: "state", title: "state", help: "sorted by when it was last written", value: (run) => run.status.time ?? run.modified, cell: (run) => html`<${State} status=${run.status} />` },
    { key: "verdict", title: "verdict", help: "is it working? A word; all of it on the overview. Sorted from the worst to the best", value: (run) => run.verdict?.rank, cell: (run) => html`<${Word} run=${run} />` },
    { key: "recipe", title: "recipe", value: (run) => run.name, cell: (run) => run.name ?? "-" },
    { key: "env_steps", title: "env steps", term: "env step", isNumber: true, value: last("progress/env_steps"), cell: (run) => `${short(run.last?.["progress/env_steps"])}${progress(run)}` },
    { key: "update", title: "update", term: "update", isNumber: true, value: last("update"), cell: (run) => run.last?.update ?? "-" },
    { key: "speed", title: "steps/s", help: "environment steps per second, everything included", isNumber: true, value: last("progress/env_steps_per_second"), cell: (run) => short(run.last?.["progress/env_steps_per_second"]) },
    { key: "training", title: "training solve rate", term: "training solve rate", help: "of the last update, first episodes on buffer and fresh levels together", isNumber: true, value: last("train/solve_rate"), cell: (run) => trained(run.last) },
    { key: "evaluated", title: "evaluated", term: "evaluation", help: "of the first set of the last evaluation, with its 95 % interval and episodes; Compare has all sets", isNumber: true, value: (run) => firstRate(run)[1]?.rate, cell: evaluated },
  ];
}

/** The verdict in a word, the sentence on hovering. @param {{ run: any }} props */
function Word({ run }) {
  if (!run.verdict) return html`<span class="soft" title="it is being judged">…</span>`;
  const { outcome, state, heading } = run.verdict;
  return html`<a class="word" href=${addressOf(["run", run.id, "overview"])} title=${heading}><${Mark} state=${state} /> ${outcome}</a>`;
}

/** @param {any} run */
function progress(run) {
  const done = run.last?.["progress/env_steps"];
  return done && run.total_env_steps ? ` (${Math.min(100, Math.round((100 * done) / run.total_env_steps))} %)` : "";
}

/** @param {any} last */
function trained(last) {
  const rate = last?.["train/solve_rate"];
  if (rate === undefined || rate === null) return "-";
  const attempts = last["train/attempts"];
  return attempts ? `${percent(rate)} of ${short(attempts)}` : percent(rate);
}

/** @param {any} run @returns {[string, any] | []} */
function firstRate(run) {
  return /** @type {[string, any] | undefined} */ (Object.entries(run.evaluated ?? {})[0]) ?? [];
}

/** @param {any} run */
function evaluated(run) {
  const [name, rate] = firstRate(run);
  return rate ? html`<span title=${`${name}, ${count(rate.attempts, "episode")}`}>${percent(rate.rate)} (${percent(interval(rate).low)} to ${percent(interval(rate).high)}) of ${rate.attempts}</span>` : "-";
}
