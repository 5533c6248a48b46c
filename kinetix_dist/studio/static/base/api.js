// Requests to the server. Addresses are relative, so that a path prefix of a proxy works.
import { useEffect, useState } from "./html.js";

export class ApiError extends Error {
  /** @param {string} text @param {number | null} [status] of the answer, where there was one */
  constructor(text, status = null) {
    super(text);
    this.isGone = status === 404;
  }
}

/**
 * JSON of an address below api/; throws ApiError with one line.
 * @param {string} path
 * @param {Record<string, string | number | null | undefined>} [query]
 * @returns {Promise<any>}
 */
export async function get(path, query = {}) {
  const fields = Object.entries(query).filter(([, value]) => value !== null && value !== undefined && value !== "");
  const text = new URLSearchParams(fields.map(([name, value]) => [name, String(value)])).toString();
  let answer;
  try {
    answer = await fetch(`api/${path}${text ? `?${text}` : ""}`);
  } catch {
    throw new ApiError("the server does not answer; is `kinetix-dist dashboard` still running?");
  }
  if (answer.status === 401) {
    throw new ApiError("no access any more: the server was started again; open the address that it printed");
  }
  const content = await answer.json().catch(() => ({ error: `the server answered ${answer.status}` }));
  if (!answer.ok) throw new ApiError(content.error ?? `the server answered ${answer.status}`, answer.status);
  return content;
}

/**
 * The result of a request, requested again when an input changes; the result before stays until then.
 * @template T
 * @param {() => Promise<T>} load
 * @param {readonly unknown[]} inputs
 * `isGone`: the requested object does not exist any more.
 * @returns {{ data: T | null, error: string | null, isGone: boolean, isLoading: boolean }}
 */
export function useRequest(load, inputs) {
  const [state, set] = useState(
    /** @type {{ data: T | null, error: string | null, isGone: boolean, isLoading: boolean }} */ ({
      data: null,
      error: null,
      isGone: false,
      isLoading: true,
    }),
  );
  useEffect(() => {
    let isCurrent = true;
    set((before) => ({ ...before, isGone: false, isLoading: true }));
    load().then(
      (data) => isCurrent && set({ data, error: null, isGone: false, isLoading: false }),
      (error) => isCurrent && set((before) => ({ ...before, error: String(error.message ?? error), isGone: Boolean(error.isGone), isLoading: false })),
    );
    return () => {
      isCurrent = false;
    };
  }, inputs);
  return state;
}
