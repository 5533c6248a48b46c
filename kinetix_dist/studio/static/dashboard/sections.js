// Sections of a page that fold: what is folded stays so, in this browser, for all runs.
import { html, useState } from "../base/html.js";

const STORED = "kinetix-dist folded sections";

/** Titles of folded sections, and a function that folds one or opens it. @returns {[Set<string>, (title: string, isOpen: boolean) => void]} */
export function useFolded() {
  const [folded, set] = useState(() => new Set((localStorage.getItem(STORED) ?? "").split(",").filter(Boolean)));
  const fold = (/** @type {string} */ title, /** @type {boolean} */ isOpen) => set((now) => { // several may come at once
    const next = new Set(now);
    if (isOpen) next.delete(title);
    else next.add(title);
    localStorage.setItem(STORED, [...next].join(","));
    return next;
  });
  return [folded, fold];
}

/** `note`: what is to be seen of a folded section. Contents exist while it is open.
 * @param {{ title: string, isOpen: boolean, fold: (title: string, isOpen: boolean) => void, note?: any, children?: any }} props */
export function Section({ title, isOpen, fold, note, children }) {
  return html`<details class="section" data-section=${title} open=${isOpen}>
    <summary onClick=${(/** @type {Event} */ event) => (event.preventDefault(), fold(title, !isOpen))}><h2>${title}</h2> ${note}</summary>
    ${isOpen ? children : null}
  </details>`;
}
