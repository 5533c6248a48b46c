// A command for a terminal, with a button that copies it.
import { html, useRef, useState } from "../base/html.js";

/** @param {{ text: string }} props */
export function Command({ text }) {
  const shown = useRef(/** @type {HTMLElement | null} */ (null));
  const [note, setNote] = useState("");
  const copy = async () => {
    getSelection()?.selectAllChildren(/** @type {HTMLElement} */ (shown.current));
    // Browsers give pages the clipboard on this machine and over HTTPS only, and may refuse there too.
    const isCopied = await (navigator.clipboard?.writeText(text).then(() => true, () => false) ?? false);
    setNote(isCopied ? "copied" : "it is selected: press Ctrl-C");
  };
  return html`<div class="command"><pre ref=${shown}>${text}</pre><span><button onClick=${copy}>copy</button> <span class="soft" role="status">${note}</span></span></div>`;
}
