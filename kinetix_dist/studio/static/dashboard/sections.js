// Sections of a page that fold. What a reader folds or opens stays so, in this browser, for all runs.
import { html, useState } from "../base/html.js";

export const NARROW = "(max-width: 600px)"; // a phone: all sections are folded at first
const STORED = { wide: "kinetix-dist folded sections", narrow: "kinetix-dist open sections" }; // those that are not as at first

/** Says whether a section is open, by its title, and folds one or opens it. @returns {[(title: string) => boolean, (title: string, isOpen: boolean) => void]} */
export function useFolded() {
  const [isNarrow] = useState(() => matchMedia(NARROW).matches);
  const key = isNarrow ? STORED.narrow : STORED.wide;
  const [changed, set] = useState(() => new Set((localStorage.getItem(key) ?? "").split(",").filter(Boolean)));
  const fold = (/** @type {string} */ title, /** @type {boolean} */ isOpen) => set((now) => { // several may come at once
    const next = new Set(now);
    if (isOpen === isNarrow) next.add(title);
    else next.delete(title);
    localStorage.setItem(key, [...next].join(","));
    return next;
  });
  return [(title) => changed.has(title) === isNarrow, fold];
}

/** `note`: what is to be seen of a folded section. Contents exist while it is open.
 * @param {{ title: string, isOpen: boolean, fold: (title: string, isOpen: boolean) => void, note?: any, children?: any }} props */
export function Section({ title, isOpen, fold, note, children }) {
  return html`<details class="section" data-section=${title} open=${isOpen}>
    <summary onClick=${(/** @type {Event} */ event) => (event.preventDefault(), fold(title, !isOpen))}><h2>${title}</h2> ${note}</summary>
    ${isOpen ? children : null}
  </details>`;
}
