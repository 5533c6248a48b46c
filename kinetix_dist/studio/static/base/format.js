// Numbers, times and shares as people read them.
import { count } from "./language.js";

/** Three significant digits, thousands as k, M, G. @param {number | null | undefined} value @param {number} [digits] */
export function short(value, digits = 3) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "-";
  const size = Math.abs(value);
  if (size >= 1e9) return `${trim(value / 1e9, digits)} G`;
  if (size >= 1e6) return `${trim(value / 1e6, digits)} M`;
  if (size >= 1e4) return `${trim(value / 1e3, digits)} k`;
  if (size !== 0 && size < 1e-3) return value.toExponential(digits - 2);
  return trim(value, digits);
}

/** @param {number} value @param {number} [digits] */
function trim(value, digits = 3) {
  return String(Number(value.toPrecision(digits)));
}

/** @param {number | null | undefined} value */
export function percent(value) {
  return value === null || value === undefined ? "-" : `${(100 * value).toFixed(1)} %`;
}

/** A solve rate is never shown without its counts. @param {number} solved @param {number} episodes */
export function rateWithCount(solved, episodes) {
  return episodes ? `${percent(solved / episodes)} (${solved} of ${episodes})` : "not played";
}

/** The mean over levels, which is not solved / episodes: those with short episodes finish more. @param {any} counts */
export function rateOverLevels(counts) {
  return counts.levels ? `${percent(counts.rate)}, mean of ${count(counts.levels, "level")} (${count(counts.episodes, "episode")})` : "not played";
}

/** @param {number | null | undefined} seconds */
export function duration(seconds) {
  if (seconds === null || seconds === undefined || !Number.isFinite(seconds)) return "-";
  if (seconds < 120) return `${Math.round(seconds)} s`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min`;
  if (seconds < 172800) return `${trim(seconds / 3600)} h`;
  return `${trim(seconds / 86400)} days`;
}

/** @param {number | null | undefined} unixSeconds */
export function date(unixSeconds) {
  if (!unixSeconds) return "-";
  const text = new Date(1000 * unixSeconds).toISOString();
  return `${text.slice(0, 10)} ${text.slice(11, 16)} UTC`;
}

/** Gives a file to the person. @param {string} name @param {Blob} content */
export function download(name, content) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(content);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

/** Rows as CSV. @param {(string | number | null | undefined)[][]} rows */
export function csv(rows) {
  const cell = (/** @type {string | number | null | undefined} */ value) => {
    const text = value === null || value === undefined ? "" : String(value);
    return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return new Blob([rows.map((row) => row.map(cell).join(",")).join("\n"), "\n"], { type: "text/csv" });
}

/** Exponential moving average without bias at its start; gaps stay gaps.
 * @template {number | null | undefined} T @param {T[]} values @param {number} weight 0 (none) to below 1 @returns {T[]} */
export function smooth(values, weight) {
  if (weight <= 0) return values;
  const known = smoothed.get(values);
  if (known?.weight === weight) return /** @type {T[]} */ (known.result); // the same array: what is drawn is not drawn again
  const result = average(values, weight);
  smoothed.set(values, { weight, result });
  return /** @type {T[]} */ (result);
}

/** @type {WeakMap<(number | null | undefined)[], { weight: number, result: (number | null | undefined)[] }>} */
const smoothed = new WeakMap();

/** @param {(number | null | undefined)[]} values @param {number} weight @returns {(number | null | undefined)[]} */
function average(values, weight) {
  let sum = 0;
  let total = 0;
  return values.map((value) => {
    if (value === null || value === undefined) return value;
    sum = weight * sum + (1 - weight) * value;
    total = weight * total + (1 - weight);
    return sum / total;
  });
}

/** The interval to show with a rate: over base levels for a set of variants, over attempts for other sets.
 * @param {any} rate with low, high and interval_over_levels @returns {{ low: number, high: number }} */
export function interval(rate) {
  const over = rate.interval_over_levels;
  return over && over.base_levels < over.levels ? over : rate;
}
