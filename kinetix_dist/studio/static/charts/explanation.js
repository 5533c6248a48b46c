// The meaning of a panel below its title: two lines of it, all of them on request.
import { html, useEffect, useRef, useState } from "../base/html.js";

/** @param {{ text: any }} props */
export function Explanation({ text }) {
  const element = useRef(/** @type {HTMLElement | null} */ (null));
  const [isOpen, setOpen] = useState(false);
  const [isCut, setCut] = useState(false);
  useEffect(() => {
    const place = /** @type {HTMLElement} */ (element.current);
    const observer = new ResizeObserver(() => { // it sees a text that was just opened, too, which is cut no more
      if (place.classList.contains("folded")) setCut(place.scrollHeight > place.clientHeight + 1);
    });
    observer.observe(place);
    return () => observer.disconnect();
  }, [text]);
  return html`<div class="help"><span class=${`explanation${isOpen ? "" : " folded"}`} ref=${element}>${text}</span>
    ${isCut ? html`<button class="link" aria-expanded=${isOpen} onClick=${() => setOpen(!isOpen)}>${isOpen ? "less" : "more"}</button>` : null}</div>`;
}
