// Limits and labels of axes: constants are flat, and no two ticks have the same label.
import { short } from "../base/format.js";

// Of the value: a constant that is stored in float32 differs by less from row to row.
const NOISE = 1e-6;
const MOST_DIGITS = 15;

/** Limits with a margin around the values; a constant stands above (or below) 0. @param {number | null} low
 * @param {number | null} high @returns {[number, number]} */
export function rangeOf(low, high) {
  if (low === null || high === null) return [0, 1];
  const size = Math.max(Math.abs(low), Math.abs(high));
  if (size === 0) return [0, 1];
  if (high - low <= NOISE * size) return [Math.min(1.2 * low, 0), Math.max(1.2 * high, 0)];
  const margin = 0.06 * (high - low);
  return [low >= 0 && low < margin ? 0 : low - margin, high + margin];
}

/** Labels with as many digits as tell them apart; "" where a tick has none. @param {(number | null)[]} ticks */
export function tickLabels(ticks) {
  const labelled = ticks.filter((tick) => tick !== null);
  let digits = 3;
  while (digits < MOST_DIGITS && new Set(labelled.map((tick) => short(tick, digits))).size < labelled.length) digits++;
  return ticks.map((tick) => (tick === null ? "" : short(tick, digits)));
}
