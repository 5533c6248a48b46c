// Overview of a run: verdict, state, curves in sections, evaluations, events.
import { addressOf, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { duration, interval, percent, short } from "../base/format.js";
import { html, useRef, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { LineChart } from "../charts/line_chart.js";
import { Panel } from "../charts/panel.js";
import { label, panelsOf } from "./metric_panels.js";
import { isFound, MetricSearch, textsOf } from "./metric_search.js";
import { isOutside, NormalValues } from "./normal_values.js";
import { Notes, State } from "./parts.js";
import { Processes } from "./processes.js";
import { useSeries } from "./run_series.js";
import { Section, useFolded } from "./sections.js";
import { Verdict } from "./verdict.js";
import { LogButton, useView, ViewBar, zoom } from "./view.js";

const SHOWN_EVENTS = 200;
const DESCRIBE_MS = 3000; // between looks at what is not sent row by row: state, evaluations

/** @param {{ run: string }} props */
export function OverviewPage({ run }) {
  const view = useView();
  const find = useAddress().query.get("find") ?? "";
  const [isOpen, fold] = useFolded();
  const [unfolded, setUnfolded] = useState(/** @type {string[]} */ ([])); // sections whose further metrics are shown
  const [described, setDescribed] = useState(0); // changes of which the description knows
  const about = useRequest(() => get(`runs/${encodeURIComponent(run)}`), [run, described]);
  const metrics = about.data?.metrics ?? {};
  const names = Object.keys(metrics);
  const sections = sectionsOf(metrics, about.data?.sections ?? [], { find, isOpen, unfolded });
  const shown = sections.filter((section) => section.isOpen).flatMap((section) => [...section.panels, ...(section.hasOthers ? section.others : [])]);
  const watched = names.filter((name) => metrics[name].normal); // of folded sections too: what is outside is said
  const wanted = [...new Set(["progress/env_steps", "progress/env_steps_per_second", ...watched, ...shown.flatMap((panel) => panel.names)])];
  const { curves, error, changes, bytesLeft, problems } = useSeries(run, names.length ? wanted : [], view);
  const newest = useRef(changes);
  const timer = useRef(/** @type {ReturnType<typeof setTimeout> | null} */ (null));
  newest.current = changes;
  if (changes > described && !about.isLoading) { // an answer that takes longer than this would never be shown
    timer.current ??= setTimeout(() => {
      timer.current = null;
      setDescribed(newest.current);
    }, DESCRIBE_MS);
  }
  const data = about.data;
  const notes = [...new Set([about.error, error, ...(data?.problems ?? []), ...(problems ?? [])])].filter(Boolean);
  if (bytesLeft) notes.push(`reading metrics, ${short(bytesLeft)}B left`);
  const verdict = html`<${Verdict} run=${run} changes=${described} notes=${notes} />`; // requested at once, beside the rest
  if (!data) return html`<main>${verdict}<${Notes} notes=${notes} />${about.error ? "" : html`<p class="missing">reading ${run} ...</p>`}</main>`;
  const chart = (/** @type {import("./metric_panels.js").MetricPanel} */ panel) =>
    html`<${MetricPanel} key=${panel.title} panel=${panel} curves=${curves} view=${view} metrics=${data.metrics} run=${run} />`;
  return html`<main>
    ${verdict}
    <${Facts} data=${data} curves=${curves} />
    <${Notes} notes=${notes} />
    <${ViewBar} view=${view}><${MetricSearch} find=${find} /></${ViewBar}>
    ${names.length ? null : html`<p class="missing">No metrics so far (metrics/metrics.jsonl); they come with the first update.</p>`}
    ${find && !sections.length ? html`<p class="missing">No metric of this run has "${find.trim()}" in its name, unit or meaning.</p>` : null}
    ${sections.map((section) => html`<${Section} key=${section.title} title=${section.title} isOpen=${section.isOpen} fold=${fold} note=${noteOf(section, curves, metrics)}>
      <div class="grid">
        ${section.hasEvaluations ? html`<${Evaluations} run=${run} view=${view} changes=${described} />` : null}
        ${section.panels.map(chart)}
        ${section.hasOthers ? section.others.map(chart) : null}
      </div>
      ${section.others.length && !find ? html`<button class="link further" aria-expanded=${section.hasOthers}
        onClick=${() => setUnfolded((now) => (section.hasOthers ? now.filter((one) => one !== section.title) : [...now, section.title]))}>
        ${section.hasOthers ? "fewer metrics" : count(section.others.length, "more metric")}</button>` : null}
    </${Section}>`)}
    <${Processes} run=${run} changes=${described} />
    <${Events} run=${run} changes=${described} />
    <${Config} config=${data.config} report=${data.report} />
  </main>`;
}

const EVALUATED = "evaluation: solve rates of held-out levels, 95 % intervals, random actions";

/**
 * Sections that have something to show, with their panels and further metrics; those that a search finds, all open.
 * @param {Record<string, any>} metrics @param {string[]} titles
 * @param {{ find: string, isOpen: (title: string) => boolean, unfolded: string[] }} chosen
 */
function sectionsOf(metrics, titles, { find, isOpen, unfolded }) {
  const { panels, others } = panelsOf(Object.keys(metrics));
  return titles.map((title, index) => {
    const isHere = (/** @type {import("./metric_panels.js").MetricPanel} */ panel) => metrics[panel.names[0]].section === title
      && (!find || isFound(find, [panel.title, panel.help, ...panel.names.flatMap((name) => textsOf(name, metrics[name]))]));
    const section = { title, panels: panels.filter(isHere), others: others.filter(isHere), hasEvaluations: index === 0 && (!find || isFound(find, [EVALUATED])) };
    return { ...section, isOpen: Boolean(find) || isOpen(title), hasOthers: Boolean(find) || unfolded.includes(title) };
  }).filter((section) => section.panels.length || section.others.length || section.hasEvaluations);
}

/** How many panels a section has, and which of its metrics are outside the range of a healthy run.
 * @param {ReturnType<typeof sectionsOf>[number]} section @param {import("./run_series.js").Curves | null} curves @param {Record<string, any>} metrics */
function noteOf(section, curves, metrics) {
  const outside = [...section.panels, ...section.others].flatMap((panel) => panel.names).filter((name) => isOutside(curves?.series[name], metrics[name].normal));
  const count = section.panels.length + section.others.length + (section.hasEvaluations ? 1 : 0);
  return html`<span class="soft">${count} ${count === 1 ? "chart" : "charts"}</span>
    ${outside.length ? html`<span class="bad">⚠ ${outside.map(label).join(", ")} above normal</span>` : null}`;
}

/** @param {{ data: any, curves: import("./run_series.js").Curves | null }} props */
function Facts({ data, curves }) {
  const { config, status } = data;
  const last = (/** @type {string} */ name) => curves?.series[name]?.mean.findLast((value) => value !== null);
  const facts = [
    ["state", html`<${State} status=${status} />`],
    ["why", status.text],
    ["env steps", config?.config?.run?.total_env_steps ? `${short(status.env_steps ?? last("progress/env_steps"))} of ${short(config.config.run.total_env_steps)}` : "-"],
    ["speed", `${short(last("progress/env_steps_per_second"))} env steps/s`],
    ...(status.seconds_left !== undefined && status.seconds_left !== null ? [["time left", duration(status.seconds_left)]] : []),
    ["config", config?.hash ?? "-"],
    ["directory", data.path],
  ];
  return html`<dl class="facts">${facts.map(([name, value]) => html`<div key=${name}><dt>${name}</dt><dd>${value}</dd></div>`)}</dl>`;
}

/** @param {{ panel: import("./metric_panels.js").MetricPanel, curves: any, view: any, metrics: any, run: string }} props */
function MetricPanel({ panel, curves, view, metrics, run }) {
  const names = panel.names.filter((name) => curves?.series[name]);
  const units = [...new Set(panel.names.map((name) => metrics[name]?.unit).filter(Boolean))];
  const lines = names.map((name) => {
    const curve = curves.series[name];
    return { label: label(name), values: curve.mean, low: curve.min, high: curve.max };
  });
  const help = panel.help ?? (panel.names.length === 1 ? metrics[panel.names[0]].meaning : panel.names.map((name) => `${label(name)}: ${metrics[name].meaning}`).join("\n"));
  const normal = panel.names.length === 1 ? metrics[panel.names[0]].normal?.high : null;
  const rows = () => [[view.axis, ...names], ...curves.x.map((/** @type {number} */ x, /** @type {number} */ k) => [x, ...names.map((name) => curves.series[name].mean[k])])];
  const title = units.length === 1 ? `${panel.title} (${units[0]})` : panel.title;
  return html`<${Panel} title=${title} help=${help} rows=${rows} name=${`${run} ${panel.title}`} wide=${panel.wide} metrics=${panel.names}
    buttons=${panel.stacked ? null : html`<${LogButton} name=${panel.title} log=${view.log} />`}>
    ${curves ? html`<${LineChart} x=${curves.x} lines=${lines} axis=${curves.unit} events=${curves.events} stacked=${panel.stacked} smoothing=${view.smooth} normal=${normal}
      log=${view.log.has(panel.title)} range=${[view.from, view.to]} onZoom=${zoom} />
      <${NormalValues} names=${names} curves=${curves} metrics=${metrics} />` : html`<div class="chart empty"></div>`}
  </${Panel}>`;
}

/** Rates of the evaluation sets, with 95 % intervals; random actions as the line to beat.
 * @param {{ run: string, view: ReturnType<typeof useView>, changes: number }} props */
function Evaluations({ run, view, changes }) {
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/evaluations`), [run, changes]);
  const sets = Object.entries(data?.sets ?? {});
  const axis = view.axis === "updates" ? "update" : "env_steps";
  const points = sets.flatMap(([, set]) => set.points.filter((/** @type {any} */ p) => p.phase !== "random_policy"));
  const x = [...new Set(points.map((/** @type {any} */ point) => point[axis]))].sort((a, b) => a - b);
  const lines = sets.flatMap(([name, set], index) => {
    const found = x.map((place) => set.points.findLast((/** @type {any} */ p) => p[axis] === place && p.phase !== "random_policy"));
    const at = (/** @type {(p: any) => number} */ field) => found.map((p) => (p ? field(p) : null));
    const baseline = set.points.find((/** @type {any} */ p) => p.phase === "random_policy");
    return [
      { label: name, values: at((p) => p.rate), low: at((p) => interval(p).low), high: at((p) => interval(p).high), style: 2 * index, isMeasured: true },
      ...(baseline ? [{ label: `${name}, random actions`, values: x.map(() => baseline.rate), style: 2 * index + 1 }] : []),
    ];
  });
  const rows = () => [["set", "phase", "update", "env_steps", "rate", "low", "high", "episodes"],
    ...sets.flatMap(([name, set]) => set.points.map((/** @type {any} */ p) => [name, p.phase, p.update, p.env_steps, p.rate, interval(p).low, interval(p).high, p.episodes]))];
  const missing = error ?? (data && !sets.length ? "No evaluation so far (evaluations.jsonl); evaluation.every sets how often." : null);
  return html`<${Panel} title="Evaluation: solve rates (share)" help="levels that are never trained on; a point for each evaluation, with its 95 % interval: over attempts, of the rate on these levels; over base levels where a set has variants of them" missing=${missing} rows=${rows}
    name=${`${run} evaluation`} buttons=${html`<a class="button" href=${addressOf(["run", run, "evaluation"])}>levels</a>`}>
    ${data ? html`<${LineChart} x=${x} lines=${lines} axis=${axis === "update" ? "updates" : "env steps"} />
      <p class="keys">${sets.map(([name, set]) => { const p = set.points.at(-1); return `${name}: ${percent(p.rate)} of ${count(p.episodes, "episode")}`; }).join(" · ")}</p>` : null}
  </${Panel}>`;
}

/** @param {{ run: string, changes: number }} props */
function Events({ run, changes }) {
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/events`), [run, changes]);
  const [filter, setFilter] = useState("");
  if (error || !data) return html`<${Notes} notes=${error ? [error] : []} />`;
  const shown = data.events.filter((/** @type {any} */ e) => JSON.stringify(e).includes(filter)).slice(-SHOWN_EVENTS).reverse();
  const rows = () => [["time", "update", "event", "details"], ...data.events.map((/** @type {any} */ event) => {
    const { time, event: kind, update, ...details } = event;
    return [time, update ?? "", kind, detailText(details)];
  })];
  return html`<${Panel} title="Events" help=${`${data.count} in events.jsonl, newest first`} rows=${rows} name=${`${run} events`} wide=${true} picture=${false}
    buttons=${html`<input placeholder="filter" value=${filter} onInput=${(/** @type {any} */ e) => setFilter(e.target.value)} aria-label="filter events" />`}>
    ${data.count ? html`<div class="scroll short"><table><tbody>${shown.map((/** @type {any} */ event, /** @type {number} */ k) => {
      const { time, event: kind, update, ...details } = event;
      return html`<tr key=${k}><td class="soft time">${time}</td><td>${update ?? ""}</td><td><b>${kind}</b></td><td>${detailText(details)}</td></tr>`;
    })}</tbody></table></div>` : html`<p class="missing">No events so far (events.jsonl).</p>`}
  </${Panel}>`;
}

/** @param {Record<string, any>} details */
function detailText(details) {
  return Object.entries(details).map(([name, value]) => `${name} ${valueText(value)}`).join(", ");
}

/** A solve rate with its interval and its count; other objects in brackets. @param {any} value @returns {string} */
function valueText(value) {
  if (value === null || typeof value !== "object") return String(value);
  if (Array.isArray(value)) return JSON.stringify(value);
  if ("rate" in value && "attempts" in value) return `${percent(value.rate)} (${percent(interval(value).low)} to ${percent(interval(value).high)}) of ${value.attempts}`;
  return `(${detailText(value)})`;
}

/** @param {{ config: any, report: any }} props */
function Config({ config, report }) {
  return html`<details><summary>Configuration and report</summary><div class="columns">
    <pre>${config ? JSON.stringify(config.config, null, 1) : "no config.json"}</pre>
    <pre>${report ? JSON.stringify(report, null, 1) : "no report.json so far: it is written at the end"}</pre></div></details>`;
}
