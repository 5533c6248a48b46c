// Small parts of several pages.
import { date } from "../base/format.js";
import { html, useEffect, useState } from "../base/html.js";
import { ago } from "../base/language.js";

const MARKS = { running: "▶", silent: "?", finished: "✓", stopped: "■", failed: "✗", "not started": "…" };

const AGO_MS = 10_000; // between looks at the clock

/** State of a run: a mark, a word, since when, and why on hovering.
 * @param {{ status: { state: string, text: string, source: string, time?: number | null } }} props */
export function State({ status }) {
  const mark = MARKS[/** @type {keyof typeof MARKS} */ (status.state)] ?? "";
  return html`<span class=${`state ${status.state.replace(" ", "-")}`} title=${`${status.text} (from ${status.source})`}>${mark} ${status.state}</span>
    ${status.time ? html` <${Ago} time=${status.time} what=${status.state === "running" || status.state === "silent" ? "written" : ""} />` : null}`;
}

/** A time as people say it, and its date on hovering; `what` happened then, in a word. @param {{ time: number, what?: string }} props */
export function Ago({ time, what = "" }) {
  const [, look] = useState(0);
  useEffect(() => {
    const timer = setInterval(() => look((count) => count + 1), AGO_MS);
    return () => clearInterval(timer);
  }, []);
  return html`<time class="ago" datetime=${new Date(1000 * time).toISOString()} title=${date(time)}>${what} ${ago(Date.now() / 1000 - time)}</time>`;
}

/** Lines about what is wrong or missing. @param {{ notes: string[] }} props */
export function Notes({ notes }) {
  return notes.length ? html`<ul class="notes" role="status">${notes.map((note) => html`<li key=${note}>${note}</li>`)}</ul>` : null;
}
