// A panel that an address names (#/run/a/overview?panel=Losses): scrolled to once it is there, out of a folded section too.
import { useEffect } from "./html.js";

const LOOK_MS = 100;
const OPEN_AFTER_MS = 700; // without the panel: it may be in a folded section
const STEADY_MS = 1500; // charts above it are still drawn, which moves it
const GIVE_UP_MS = 10_000;
const BY_THE_READER = ["wheel", "touchstart", "keydown", "pointerdown"]; // who scrolls from then on

/** Scrolls to the panel of an address, whenever that changes. @param {import("./address.js").Address} address */
export function usePanelOfAddress({ parts, query }) {
  const title = query.get("panel");
  useEffect(() => (title ? showPanel(title) : undefined), [parts.join("/"), title]);
}

/** Scrolls to a panel by its title, how that begins, or a metric that it shows. @param {string} title @returns {() => void} ends it */
export function showPanel(title) {
  const start = performance.now();
  let foundAt = 0;
  let isOpened = false;
  const stop = () => {
    clearInterval(timer);
    for (const kind of BY_THE_READER) removeEventListener(kind, stop);
  };
  const timer = setInterval(() => {
    const now = performance.now();
    const element = findPanel(title);
    if (element) {
      element.scrollIntoView({ block: "start" });
      if (!foundAt) {
        foundAt = now;
        element.tabIndex = -1;
        element.focus({ preventScroll: true });
      }
    } else if (!isOpened && now - start > OPEN_AFTER_MS) {
      isOpened = true;
      for (const folded of document.querySelectorAll("main details:not([open]) > summary, main .further[aria-expanded='false']")) /** @type {HTMLElement} */ (folded).click();
    }
    if (now - (foundAt || start) > (foundAt ? STEADY_MS : GIVE_UP_MS)) stop();
  }, LOOK_MS);
  for (const kind of BY_THE_READER) addEventListener(kind, stop, { passive: true });
  return stop;
}

/** The panel whose title is this, else one that shows the metric of this name, or begins with these words. @param {string} title */
function findPanel(title) {
  const panels = /** @type {HTMLElement[]} */ ([...document.querySelectorAll("[data-panel]")]);
  const shows = panels.find((panel) => panel.dataset.metrics?.split(" ").includes(title));
  if (shows) return shows;
  const begins = panels.filter((panel) => panel.dataset.panel?.startsWith(title));
  return begins.find((panel) => panel.dataset.panel === title)
    ?? begins.find((panel) => !/^\w/.test(panel.dataset.panel?.slice(title.length) ?? "")) ?? begins[0];
}
