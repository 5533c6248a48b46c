// Table of runs with state, progress and solve rates; chosen ones go to the comparison.
import { addressOf } from "../base/address.js";
import { get } from "../base/api.js";
import { date, interval, percent, short } from "../base/format.js";
import { html, useEffect, useState } from "../base/html.js";
import { Notes, State } from "./parts.js";

const REFRESH_MS = 5000;

export function RunsPage() {
  const [answer, setAnswer] = useState(/** @type {any} */ (null));
  const [error, setError] = useState(/** @type {string | null} */ (null));
  const [chosen, setChosen] = useState(/** @type {string[]} */ ([]));
  const [filter, setFilter] = useState("");
  useEffect(() => {
    let isHere = true;
    const load = () =>
      get("runs").then(
        (found) => isHere && (setAnswer(found), setError(null)),
        (problem) => isHere && setError(problem.message),
      );
    load();
    const timer = setInterval(() => !document.hidden && load(), REFRESH_MS);
    return () => {
      isHere = false;
      clearInterval(timer);
    };
  }, []);
  if (!answer) return html`<${Notes} notes=${error ? [error] : []} /><p class="missing">${error ? "" : "reading runs ..."}</p>`;
  const rows = [...answer.runs]
    .filter((run) => `${run.id} ${run.name} ${run.status.state}`.includes(filter))
    .sort((a, b) => (b.modified ?? 0) - (a.modified ?? 0));
  const choose = (/** @type {string} */ id) =>
    setChosen(chosen.includes(id) ? chosen.filter((other) => other !== id) : [...chosen, id]);
  return html`<main>
    <${Notes} notes=${[...(error ? [error] : []), ...answer.problems]} />
    <div class="row">
      <input placeholder="filter by name or state" value=${filter} onInput=${(/** @type {any} */ e) => setFilter(e.target.value)} aria-label="filter runs" />
      <a class=${`button${chosen.length < 2 ? " off" : ""}`} href=${chosen.length < 2 ? undefined : addressOf(["compare"], new URLSearchParams({ runs: chosen.join(",") }))}>
        compare ${chosen.length || ""}</a>
      <span class="soft">${rows.length} of ${answer.runs.length} runs</span>
    </div>
    ${answer.runs.length ? html`<div class="scroll"><table class="runs">
      <thead><tr><th></th><th>run</th><th>state</th><th>recipe</th><th class="number">env steps</th><th class="number">update</th><th class="number">steps/s</th>
        <th class="number" title="of the last update, first episodes on buffer and fresh levels together">training solve rate</th>
        <th class="number" title="of the first set of the last evaluation, with its 95 % interval and episodes">evaluated</th><th>changed</th></tr></thead>
      <tbody>${rows.map((run) => html`<tr key=${run.id}>
        <td><input type="checkbox" checked=${chosen.includes(run.id)} onChange=${() => choose(run.id)} aria-label=${`compare ${run.id}`} /></td>
        <td><a href=${addressOf(["run", run.id, "overview"])} title=${run.path}>${run.id}</a>
          ${run.problems.map((/** @type {string} */ problem) => html`<div key=${problem} class="bad problem">${problem}</div>`)}</td>
        <td><${State} status=${run.status} /></td>
        <td>${run.name ?? "-"}</td>
        <td class="number">${short(run.last?.["progress/env_steps"])}${progress(run)}</td>
        <td class="number">${run.last?.update ?? "-"}</td>
        <td class="number">${short(run.last?.["progress/env_steps_per_second"])}</td>
        <td class="number">${trained(run.last)}</td>
        <td class="number">${evaluated(run.evaluated)}</td>
        <td>${date(run.modified)}</td></tr>`)}</tbody></table></div>`
      : html`<p class="missing">There are no runs here yet; one that starts appears by itself.</p>`}
  </main>`;
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

/** @param {any} rates */
function evaluated(rates) {
  const [name, rate] = Object.entries(rates ?? {})[0] ?? [];
  return rate ? html`<span title=${`${name}, ${rate.attempts} episodes`}>${percent(rate.rate)} (${percent(interval(rate).low)} to ${percent(interval(rate).high)}) of ${rate.attempts}</span>` : "-";
}
