// Search over the metrics of a run by name or meaning; "/" goes to its field.
import { setQuery } from "../base/address.js";
import { html, useEffect, useRef } from "../base/html.js";
import { label } from "./metric_panels.js";

/** True where a text has every word of the search. @param {string} find @param {(string | undefined)[]} texts */
export function isFound(find, texts) {
  const text = texts.join(" ").toLowerCase();
  return find.trim().toLowerCase().split(/\s+/).every((word) => text.includes(word));
}

/** What a metric is found by. @param {string} name @param {any} metric @returns {string[]} */
export function textsOf(name, metric) {
  return [name, label(name), metric?.unit ?? "", metric?.meaning ?? "", metric?.section ?? ""];
}

/** @param {{ find: string }} props */
export function MetricSearch({ find }) {
  const field = useRef(/** @type {HTMLInputElement | null} */ (null));
  useEffect(() => {
    const press = (/** @type {KeyboardEvent} */ event) => {
      const isWritten = event.target instanceof Element && event.target.closest("input, select, textarea, [contenteditable]");
      if (event.key !== "/" || isWritten || event.ctrlKey || event.metaKey || event.altKey) return;
      event.preventDefault();
      field.current?.focus();
      field.current?.select();
    };
    addEventListener("keydown", press);
    return () => removeEventListener("keydown", press);
  }, []);
  return html`<label>find <input type="search" ref=${field} value=${find} placeholder="a metric, by name or meaning ( / )" aria-label="find metrics"
    onInput=${(/** @type {any} */ e) => setQuery({ find: e.target.value || null })}
    onKeyDown=${(/** @type {KeyboardEvent} */ e) => e.key === "Escape" && setQuery({ find: null })} /></label>`;
}
