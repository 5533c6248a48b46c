// The verdict on a run: is it working, in a sentence, what to try next, and its parts, each a link to the evidence.
import { addressOf, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { html, useRef, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { showPanel } from "../base/panel_link.js";
import { Terms } from "../base/term.js";
import { Command } from "./command.js";
import { Notes } from "./parts.js";
import { NARROW } from "./sections.js";

const JUDGE_MS = 15_000; // between verdicts on a run that goes on
const VIEW = ["x", "smooth", "from", "to", "log"]; // of the address, that links leave as it is
/** @type {Record<string, string>} */
const MARKS = { good: "✓", bad: "✗", neutral: "–", unknown: "?" };
/** @type {Record<string, string>} */
const MEANINGS = { good: "good", bad: "needs a look", neutral: "neither good nor bad", unknown: "not known" };

/** @typedef {{ key: string, title: string, state: string, sentence: string, remedy: string, page: string, query: Record<string, string> }} Statement
 * @typedef {{ sentence: string, command: string, page: string, query: Record<string, string> }} NextStep */

/** @param {{ run: string, changes: number, notes: string[] }} props notes: lines that the page shows already */
export function Verdict({ run, changes, notes }) {
  const judged = useChangesNowAndThen(changes);
  const base = `runs/${encodeURIComponent(run)}/verdict`;
  const { data, error } = useRequest(() => get(base), [run, judged]);
  const failing = useRequest(() => (data ? get(`${base}/failing`) : Promise.resolve(null)), [run, data]); // the engine may take seconds
  if (!data) return html`<section class="verdict" aria-label="verdict"><h2>${error ?? "Is it working? Reading the run ..."}</h2></section>`;
  const further = data.problems.filter((/** @type {string} */ line) => !notes.includes(line));
  /** @type {Statement[]} */
  const known = failing.data?.statements ?? [];
  const statements = data.statements.map((/** @type {Statement} */ one) => known.find(({ key }) => key === one.key) ?? one);
  const seen = new Set(); // terms: each is marked once in the whole verdict
  const line = (/** @type {Statement} */ statement) => html`<${Line} key=${statement.key} run=${run} statement=${statement} seen=${seen}
    note=${statement.key === "failing" ? (failing.error ?? (failing.data ? "" : "The engine is asked what these have in common ...")) : ""} />`;
  return html`<section class="verdict" data-state=${data.state} data-outcome=${data.outcome} aria-label="verdict">
    <h2><${Mark} state=${data.state} /><span><${Terms} text=${data.heading} seen=${seen} /></span></h2>
    <${Next} run=${run} next=${data.next} seen=${seen} />
    <${Parts} statements=${statements} line=${line} />
    <${Notes} notes=${further} />
  </section>`;
}

/** All parts where there is room; on a phone those that need a look, and the others on request.
 * @param {{ statements: Statement[], line: (statement: Statement) => any }} props */
function Parts({ statements, line }) {
  const [isNarrow] = useState(() => matchMedia(NARROW).matches);
  const shown = isNarrow ? statements.filter(({ state }) => state === "bad") : statements;
  const others = statements.filter((one) => !shown.includes(one));
  return html`${shown.length ? html`<ul>${shown.map(line)}</ul>` : null}
    ${others.length ? html`<details><summary>${count(others.length, shown.length ? "other part" : "part")}: ${others.map(({ title }) => title).join(", ")}</summary><ul>${others.map(line)}</ul></details>` : null}`;
}

/** @param {{ run: string, next: NextStep, seen: Set<object> }} props */
function Next({ run, next, seen }) {
  return html`<div class="next"><p><b><${Evidence} run=${run} page=${next.page} query=${next.query}>Next</${Evidence}>:</b> <${Terms} text=${next.sentence} seen=${seen} />.</p>
    ${next.command ? html`<${Command} text=${next.command} />` : null}</div>`;
}

/** @param {{ run: string, statement: Statement, note: string, seen: Set<object> }} props */
function Line({ run, statement, note, seen }) {
  return html`<li data-statement=${statement.key}><${Mark} state=${statement.state} />
    <span><${Evidence} run=${run} page=${statement.page} query=${statement.query}>${statement.title}</${Evidence}> <${Terms} text=${statement.sentence} seen=${seen} />
      ${note ? html` <span class="soft">${note}</span>` : null}
      ${statement.remedy ? html`<span class="soft"> What may help: <${Terms} text=${statement.remedy} seen=${seen} />.</span>` : null}</span></li>`;
}

/** A link to the page, and the panel there, that shows the evidence. @param {{ run: string, page: string, query: Record<string, string>, children?: any }} props */
function Evidence({ run, page, query: chosen, children }) {
  const { query } = useAddress();
  const fields = new URLSearchParams(VIEW.flatMap((name) => (query.get(name) ? [[name, query.get(name) ?? ""]] : [])));
  for (const [name, value] of Object.entries(chosen)) fields.set(name, value);
  const address = addressOf(["run", run, page], fields);
  const show = () => { // an address that is there already changes nothing
    if (location.hash === address && chosen.panel) showPanel(chosen.panel);
  };
  return html`<a href=${address} onClick=${show}>${children}</a>`;
}

/** @param {{ state: string }} props of a statement, or of a verdict */
export function Mark({ state }) {
  return html`<span class=${`mark ${state}`} role="img" aria-label=${MEANINGS[state]} title=${MEANINGS[state]}>${MARKS[state]}</span>`;
}

/** The number of changes, as it was at most JUDGE_MS ago. @param {number} changes */
function useChangesNowAndThen(changes) {
  const [seen, set] = useState(changes);
  const newest = useRef(changes);
  const timer = useRef(/** @type {ReturnType<typeof setTimeout> | null} */ (null));
  newest.current = changes;
  if (changes > seen) {
    timer.current ??= setTimeout(() => {
      timer.current = null;
      set(newest.current);
    }, JUDGE_MS);
  }
  return seen;
}
