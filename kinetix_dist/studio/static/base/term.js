// Terms of the glossary in a page: a word with a dotted line, whose meaning opens on hovering, focus, a click or a tap.
// One box shows them all. It closes with Escape, a click elsewhere, or when the word loses pointer and focus.
import { GLOSSARY } from "./glossary.js";
import { html, useEffect, useRef } from "./html.js";

/** Entries by their names in lower case. */
const BY_NAME = new Map(Object.values(GLOSSARY).flatMap((entry) => entry.names.map((name) => [name.toLowerCase(), entry])));
/** Names in a text, the longest first; those in brackets ("role (of a shape)") are too ambiguous to be found in one. Parts of
 * settings and of files ("evaluation.every", "curriculum/outcomes.jsonl") are none. */
const IN_TEXT = new RegExp(`(?<![\\w./-])(${[...BY_NAME.keys()].filter((name) => !name.includes("(")).sort((a, b) => b.length - a.length).map((name) => name.replace(/[.*+?^${}|[\]\\]/g, "\\$&")).join("|")})(s)?(?![\\w-]|[./]\\w)`, "gi");
const CLOSE_MS = 150; // for the pointer to get from the word to the box
const MARGIN = 8;

/** @type {HTMLElement | null} */
let box = null;
/** @type {HTMLElement | null} the word that the box belongs to */
let owner = null;
let isPinned = false; // by a click: it stays when the pointer leaves
/** @type {ReturnType<typeof setTimeout> | undefined} */
let closing;

/** The word, or other words for it between the tags. Not for labels of fields: a label is that of its first button. @param {{ name: string, children?: any }} props */
export function Term({ name, children }) {
  const word = useRef(/** @type {HTMLButtonElement | null} */ (null));
  useEffect(() => () => close(word.current), []);
  const entry = BY_NAME.get(name.toLowerCase());
  if (!entry) {
    console.error(`"${name}" is no term of docs/glossary.md`);
    return children ?? name;
  }
  const here = () => open(/** @type {HTMLElement} */ (word.current), entry);
  const click = (/** @type {MouseEvent} */ event) => {
    event.preventDefault(); // of a summary, or a link: they are not meant
    event.stopPropagation();
    if (isPinned && owner === word.current) return close(word.current);
    here();
    isPinned = true;
  };
  return html`<button type="button" class="term" ref=${word} onMouseEnter=${here} onMouseLeave=${closeSoon} onFocus=${here} onBlur=${() => close(word.current)} onClick=${click}>${children ?? name}</button>`;
}

/** A text whose terms are words of the glossary, each where it appears first: in this text, or in all that share `seen`.
 * @param {{ text: string, seen?: Set<object> }} props */
export function Terms({ text, seen = new Set() }) {
  const parts = [];
  let from = 0;
  for (const match of text.matchAll(IN_TEXT)) {
    const entry = BY_NAME.get(match[1].toLowerCase());
    if (!entry || seen.has(entry)) continue;
    seen.add(entry);
    parts.push(text.slice(from, match.index), html`<${Term} name=${match[1]}>${match[0]}</${Term}>`);
    from = match.index + match[0].length;
  }
  return [...parts, text.slice(from)];
}

/** @param {HTMLElement} word @param {{ names: string[], text: string }} entry */
function open(word, entry) {
  clearTimeout(closing);
  if (owner === word) return;
  close(owner);
  box ??= makeBox();
  const heading = document.createElement("b");
  heading.textContent = entry.names.join(", ");
  box.replaceChildren(heading, `: ${entry.text}`);
  box.hidden = false;
  owner = word;
  word.setAttribute("aria-describedby", box.id);
  place(word, box);
}

/** Closes the box where it is that of a word. @param {HTMLElement | null} word */
function close(word) {
  if (!owner || owner !== word || !box) return;
  clearTimeout(closing);
  owner.removeAttribute("aria-describedby");
  owner = null;
  isPinned = false;
  box.hidden = true;
}

function closeSoon() {
  clearTimeout(closing);
  closing = setTimeout(() => {
    if (!isPinned && owner !== document.activeElement) close(owner);
  }, CLOSE_MS);
}

/** Below a word, or above it where the window ends. @param {HTMLElement} word @param {HTMLElement} box */
function place(word, box) {
  const at = word.getBoundingClientRect();
  const { offsetWidth: width, offsetHeight: height } = box;
  const isBelow = at.bottom + height + MARGIN < innerHeight || at.top < height + MARGIN;
  box.style.left = `${Math.max(MARGIN, Math.min(at.left, document.documentElement.clientWidth - width - MARGIN))}px`;
  box.style.top = `${isBelow ? at.bottom + 4 : at.top - height - 4}px`;
}

function makeBox() {
  const made = document.createElement("div");
  made.id = "meaning";
  made.setAttribute("role", "tooltip");
  made.addEventListener("mouseenter", () => clearTimeout(closing));
  made.addEventListener("mouseleave", closeSoon);
  document.body.append(made);
  addEventListener("keydown", (event) => {
    if (event.key !== "Escape" || !owner) return;
    event.stopPropagation(); // it is the box that closes, nothing behind it
    close(owner);
  }, { capture: true });
  addEventListener("pointerdown", (event) => {
    const target = /** @type {Node} */ (event.target);
    if (owner && !owner.contains(target) && !made.contains(target)) close(owner);
  }, { capture: true });
  addEventListener("scroll", () => owner && place(owner, made), { capture: true, passive: true });
  return made;
}
