// Values of metrics next to those of a healthy run: only what is outside stands out.
import { short } from "../base/format.js";
import { html } from "../base/html.js";
import { label } from "./metric_panels.js";

/** @typedef {import("./run_series.js").Curve} Curve @typedef {{ high: number, source: string } | null | undefined} Normal */

/** True where the last value is above those of a healthy run. @param {Curve | undefined} curve @param {Normal} normal */
export function isOutside(curve, normal) {
  const last = curve?.mean.findLast((value) => value !== null) ?? null;
  return Boolean(normal) && last !== null && last > /** @type {{ high: number }} */ (normal).high;
}

/** One line per metric that has a normal range; those that are 0 as they should be share one.
 * @param {{ names: string[], curves: import("./run_series.js").Curves, metrics: Record<string, any> }} props */
export function NormalValues({ names, curves, metrics }) {
  const judged = names.filter((name) => metrics[name].normal);
  if (!judged.length) return null;
  const isQuiet = (/** @type {string} */ name) => metrics[name].normal.high === 0 && !highest(curves.series[name]);
  const quiet = judged.filter(isQuiet);
  return html`<ul class="normal">
    ${judged.filter((name) => !isQuiet(name)).map((name) => html`<li key=${name}><${Judged} name=${name} curves=${curves} normal=${metrics[name].normal} /></li>`)}
    ${quiet.length ? html`<li class="soft">${quiet.length === names.length ? "" : `${quiet.map(label).join(", ")}: `}0, normal: ${metrics[quiet[0]].normal.source}</li>` : null}
  </ul>`;
}

/** @param {{ name: string, curves: import("./run_series.js").Curves, normal: { high: number, source: string } }} props */
function Judged({ name, curves, normal }) {
  const curve = curves.series[name];
  const last = curve.mean.findLast((value) => value !== null);
  const values = curve.max ?? curve.mean;
  const at = values.findLastIndex((value) => value !== null && value > normal.high);
  const range = normal.high === 0 ? "normal: 0" : `normal: below ${short(normal.high)}`;
  const earlier = at < 0 ? "" : ` Above it until ${short(curves.x[at])} ${curves.unit}, highest ${short(highest(curve))}.`;
  if (isOutside(curve, normal)) return html`<b class="bad">⚠ ${label(name)} ${short(last)}, above normal</b> <span class="soft">(${range}; ${normal.source})</span>`;
  return html`${label(name)} ${short(last)}, <span class="good">${range}</span>.<span class=${at < 0 ? "" : "bad"}>${earlier}</span> <span class="soft">${normal.source}</span>`;
}

/** @param {Curve} curve */
function highest(curve) {
  return (curve.max ?? curve.mean).reduce((/** @type {number} */ most, value) => Math.max(most, value ?? 0), 0);
}
