// The verdict on a run: is it working, in a sentence, and its parts, each a link to the evidence.
import { addressOf, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { html, useRef, useState } from "../base/html.js";
import { showPanel } from "../base/panel_link.js";
import { Notes } from "./parts.js";

const JUDGE_MS = 15_000; // between verdicts on a run that goes on
const VIEW = ["x", "smooth", "from", "to", "log"]; // of the address, that links leave as it is
/** @type {Record<string, string>} */
const MARKS = { good: "✓", bad: "✗", neutral: "–", unknown: "?" };
/** @type {Record<string, string>} */
const MEANINGS = { good: "good", bad: "needs a look", neutral: "neither good nor bad", unknown: "not known" };

/** @typedef {{ key: string, title: string, state: string, sentence: string, remedy: string, page: string, query: Record<string, string> }} Statement */

/** @param {{ run: string, changes: number, notes: string[] }} props notes: lines that the page shows already */
export function Verdict({ run, changes, notes }) {
  const judged = useChangesNowAndThen(changes);
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/verdict`), [run, judged]);
  if (!data) return html`<section class="verdict" aria-label="verdict"><h2>${error ?? "Is it working? Reading the run ..."}</h2></section>`;
  const further = data.problems.filter((/** @type {string} */ line) => !notes.includes(line));
  return html`<section class="verdict" data-state=${data.state} aria-label="verdict">
    <h2><${Mark} state=${data.state} /><span>${data.heading}</span></h2>
    <ul>${data.statements.map((/** @type {Statement} */ statement) => html`<${Line} key=${statement.key} run=${run} statement=${statement} />`)}</ul>
    <${Notes} notes=${further} />
  </section>`;
}

/** @param {{ run: string, statement: Statement }} props */
function Line({ run, statement }) {
  const { query } = useAddress();
  const fields = new URLSearchParams(VIEW.flatMap((name) => (query.get(name) ? [[name, query.get(name) ?? ""]] : [])));
  for (const [name, value] of Object.entries(statement.query)) fields.set(name, value);
  const address = addressOf(["run", run, statement.page], fields);
  const show = () => { // an address that is there already changes nothing
    if (location.hash === address && statement.query.panel) showPanel(statement.query.panel);
  };
  return html`<li data-statement=${statement.key}><${Mark} state=${statement.state} />
    <span><a href=${address} onClick=${show}>${statement.title}</a> ${statement.sentence}
      ${statement.remedy ? html`<span class="soft"> What may help: ${statement.remedy}.</span>` : null}</span></li>`;
}

/** @param {{ state: string }} props */
function Mark({ state }) {
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
