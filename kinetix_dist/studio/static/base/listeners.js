// Draws a component again when something that it shows has changed, once a picture at most.
import { useEffect, useState } from "./html.js";

/** @param {Set<() => void>} listeners are called by what changes */
export function useListeners(listeners) {
  const [, set] = useState(0);
  useEffect(() => {
    let wanted = 0;
    const update = () => {
      wanted ||= requestAnimationFrame(() => {
        wanted = 0;
        set((count) => count + 1);
      });
    };
    listeners.add(update);
    update(); // what changed since the component was drawn: effects come a picture later
    return () => {
      listeners.delete(update);
      cancelAnimationFrame(wanted);
    };
  }, [listeners]);
}
