// Small parts of several pages.
import { html } from "../base/html.js";

const MARKS = { running: "▶", silent: "?", finished: "✓", stopped: "■", failed: "✗", "not started": "…" };

/** State of a run: a mark, a word, and why on hovering. @param {{ status: { state: string, text: string, source: string } }} props */
export function State({ status }) {
  const mark = MARKS[/** @type {keyof typeof MARKS} */ (status.state)] ?? "";
  return html`<span class=${`state ${status.state.replace(" ", "-")}`} title=${`${status.text} (from ${status.source})`}>${mark} ${status.state}</span>`;
}

/** Lines about what is wrong or missing. @param {{ notes: string[] }} props */
export function Notes({ notes }) {
  return notes.length ? html`<ul class="notes" role="status">${notes.map((note) => html`<li key=${note}>${note}</li>`)}</ul>` : null;
}
