// Curves of a run that grow while it trains: requested once, then rows are added as the channel brings them.
import { get } from "../base/api.js";
import { channel } from "../base/channel.js";
import { useEffect, useRef, useState } from "../base/html.js";

/**
 * @typedef {{ mean: (number | null)[], min?: (number | null)[], max?: (number | null)[] }} Curve
 * @typedef {{ x: number[], series: Record<string, Curve>, rows: number, revision: number, unit: string,
 *   events: { x: number, event: string, number: number }[] }} Curves
 */

const POINTS = 400; // about one a pixel of a chart in the grid: more cost time in the server and in the browser, unseen
const REFETCH_MS = 2000;
/** @type {Record<string, string | null>} */
const AXIS_METRIC = { env_steps: "progress/env_steps", updates: "update", seconds: "progress/seconds", time: null };

/**
 * `changes` counts what came since, of rows and events; `bytesLeft` while a long file is read for the first time.
 * @param {string} run
 * @param {string[]} names
 * @param {{ axis: string, from: number | null, to: number | null }} view
 * @returns {{ curves: Curves | null, error: string | null, changes: number, bytesLeft: number, problems: string[] | null }}
 */
export function useSeries(run, names, view) {
  const [state, setState] = useState({
    curves: /** @type {Curves | null} */ (null),
    error: /** @type {string | null} */ (null),
    changes: 0,
    bytesLeft: 0,
    problems: /** @type {string[] | null} */ (null),
  });
  const curves = useRef(/** @type {Curves | null} */ (null));
  useEffect(() => {
    let isHere = true;
    let added = 0;
    /** @type {ReturnType<typeof setTimeout> | null} */
    let timer = null;
    const show = (/** @type {Partial<typeof state>} */ fields) =>
      isHere && setState((before) => ({ ...before, ...fields, curves: curves.current && { ...curves.current } }));
    const load = async () => {
      timer = null;
      try {
        const query = { names: names.join(","), x: view.axis, points: POINTS, from: view.from, to: view.to };
        const found = await get(`runs/${encodeURIComponent(run)}/series`, query);
        if (!isHere) return;
        curves.current = found;
        added = 0;
        show({ error: null, bytesLeft: 0 });
      } catch (error) {
        show({ error: String(/** @type {Error} */ (error).message) });
      }
    };
    const askSoon = () => {
      if (names.length) timer ??= setTimeout(load, REFETCH_MS);
    };
    if (names.length) load();
    const place = () => ({ since: curves.current?.rows ?? null, revision: curves.current?.revision ?? null });
    const stop = channel.watch(run, place, (message) => {
      if (message.type === "reading") show({ bytesLeft: message.bytes_left });
      else if (message.type === "rewound") askSoon();
      else if (message.type === "events") setState((before) => ({ ...before, changes: before.changes + 1 }));
      else if (message.type === "problems") show({ problems: message.problems });
      else if (message.type === "rows") {
        const metric = AXIS_METRIC[view.axis];
        const isNext = curves.current && message.first === curves.current.rows && message.revision === curves.current.revision;
        const columns = message.columns;
        if (isNext && metric && columns[metric] && view.to === null && added < POINTS) {
          append(/** @type {Curves} */ (curves.current), columns, metric, names);
          added += columns.update.length;
        } else if (!curves.current || message.first + columns.update.length > curves.current.rows) askSoon();
        setState((before) => ({ ...before, changes: before.changes + 1, curves: curves.current && { ...curves.current } }));
      }
    });
    return () => {
      isHere = false;
      if (timer) clearTimeout(timer);
      stop();
    };
  }, [run, names.join(","), view.axis, view.from, view.to]);
  return state;
}

/** @param {Curves} curves @param {Record<string, (number | null)[]>} columns @param {string} metric @param {string[]} names */
function append(curves, columns, metric, names) {
  const before = curves.x.length;
  const count = columns.update.length;
  curves.x = [...curves.x, .../** @type {number[]} */ (columns[metric])];
  for (const name of names) {
    const curve = curves.series[name];
    const values = columns[name] ?? Array(count).fill(null);
    if (!curve) {
      if (columns[name]) curves.series[name] = { mean: [...Array(before).fill(null), ...values] };
      continue;
    }
    curve.mean = [...curve.mean, ...values];
    if (curve.min && curve.max) {
      curve.min = [...curve.min, ...values];
      curve.max = [...curve.max, ...values];
    }
  }
  curves.rows += count;
}
