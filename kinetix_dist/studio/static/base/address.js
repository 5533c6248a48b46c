// The state of a view is in the address (behind #), so that a view can be sent and the browser's "back" works.
//   #/run/quickstart/overview?x=updates&smooth=0.6
import { useEffect, useState } from "./html.js";

/** @typedef {{ parts: string[], query: URLSearchParams }} Address */

/** @returns {Address} */
export function readAddress() {
  const [path, query = ""] = location.hash.replace(/^#\/?/, "").split("?");
  return { parts: path.split("/").filter(Boolean).map(decoded), query: new URLSearchParams(query) };
}

/** A part of an address that a person typed may hold a `%` that begins no escape. @param {string} part */
function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

/**
 * @param {string[]} parts
 * @param {URLSearchParams} [query]
 */
export function addressOf(parts, query) {
  const text = query ? query.toString() : "";
  return `#/${parts.map(encodeURIComponent).join("/")}${text ? `?${text}` : ""}`;
}

/**
 * Changes fields of the query; null or "" removes one. Does not add to the history: "back" leads to the page before.
 * @param {Record<string, string | null>} fields
 */
export function setQuery(fields) {
  const { parts, query } = readAddress();
  for (const [name, value] of Object.entries(fields)) {
    if (value === null || value === "") query.delete(name);
    else query.set(name, value);
  }
  history.replaceState(null, "", addressOf(parts, query));
  dispatchEvent(new Event("hashchange"));
}

/** The address; the component is drawn again when it changes. @returns {Address} */
export function useAddress() {
  const [address, set] = useState(readAddress);
  const drawn = location.hash;
  useEffect(() => {
    const update = () => set(readAddress());
    addEventListener("hashchange", update);
    if (location.hash !== drawn) update(); // before this: effects come a picture later
    return () => removeEventListener("hashchange", update);
  }, []);
  return address;
}
