// Number of changes of a run since a page was opened: pages that show whole files request them again then.
import { channel } from "../base/channel.js";
import { useEffect, useState } from "../base/html.js";

const QUIET_MS = 2000; // several rows in a row are one change

/** @param {string} run */
export function useRunChanges(run) {
  const [changes, set] = useState(0);
  useEffect(() => {
    let last = { since: /** @type {number | null} */ (null), revision: /** @type {number | null} */ (null) };
    /** @type {ReturnType<typeof setTimeout> | null} */
    let timer = null;
    const stop = channel.watch(run, () => last, (message) => {
      if (message.type === "rows") last = { since: message.first + message.columns.update.length, revision: message.revision };
      if (!["rows", "rewound", "events"].includes(message.type)) return;
      timer ??= setTimeout(() => {
        timer = null;
        set((before) => before + 1);
      }, QUIET_MS);
    });
    return () => {
      if (timer) clearTimeout(timer);
      stop();
    };
  }, [run]);
  return changes;
}
