// What a level has of each kind of element, and what its size has slots for.
import { count } from "../base/language.js";

/**
 * @typedef {import("./document.js").Level} Level
 * @typedef {"polygons" | "circles" | "joints" | "thrusters"} Kind
 * @typedef {Record<Kind, number>} Counts
 * @typedef {{ shapes?: any[], joints?: any[], thrusters?: any[] }} Elements
 */

const KINDS = /** @type {const} */ (["polygons", "circles", "joints", "thrusters"]);
/** @type {Record<Kind, [string, string]>} */
const WORDS = { polygons: ["box or polygon", "boxes or polygons"], circles: ["circle", "circles"], joints: ["joint", "joints"], thrusters: ["thruster", "thrusters"] };

/** @param {Elements} elements @returns {Counts} */
export function countsOf({ shapes = [], joints = [], thrusters = [] }) {
  const circles = shapes.filter((shape) => shape?.type === "circle").length;
  return { polygons: shapes.length - circles, circles, joints: joints.length, thrusters: thrusters.length };
}

/** @param {Counts} a @param {Counts} b @returns {Counts} */
export const sum = (a, b) => /** @type {Counts} */ (Object.fromEntries(KINDS.map((kind) => [kind, a[kind] + b[kind]])));

/** Kinds of which there are more than a size has slots for. @param {Counts} counts @param {Counts | undefined} most @returns {Kind[]} */
const over = (counts, most) => (most ? KINDS.filter((kind) => counts[kind] > most[kind]) : []);

/** The smallest size larger than one that has slots for so many; null: there is none.
 * @param {Record<string, any>} sizes of the engine, smallest first @param {string} size @param {Counts} counts @returns {string | null} */
export function largerSize(sizes, size, counts) {
  const names = Object.keys(sizes);
  return names.slice(names.indexOf(size) + 1).find((name) => !over(counts, sizes[name]).length) ?? null;
}

/** Size that a level with too many elements would fit. null: it fits its own, or none.
 * @param {Record<string, any>} sizes @param {Level} document @returns {string | null} */
export function sizeThatFits(sizes, document) {
  const counts = countsOf(document);
  return over(counts, sizes[document.size]).length ? largerSize(sizes, document.size, counts) : null;
}

/** What keeps a part out of a level, in words; "": nothing. @param {Record<string, any>} sizes @param {Level} document @param {Elements} part */
export function lacking(sizes, document, part) {
  const [has, needs, most] = [countsOf(document), countsOf(part), sizes[document.size]];
  return over(sum(has, needs), most)
    .filter((kind) => needs[kind])
    .map((kind) => `${count(needs[kind], ...WORDS[kind])} (size ${document.size} has room for ${Math.max(most[kind] - has[kind], 0)} more)`)
    .join(" and ");
}

/** Slots that are free, in words. @param {Record<string, any>} sizes @param {Level} document */
export function freeWords(sizes, document) {
  const [has, most] = [countsOf(document), sizes[document.size]];
  return most ? KINDS.map((kind) => count(Math.max(most[kind] - has[kind], 0), ...WORDS[kind])).join(", ") : "";
}

/** True where a kind of element has no slot left. @param {Record<string, any>} sizes @param {Level} document */
export function isFull(sizes, document) {
  const [has, most] = [countsOf(document), sizes[document.size]];
  return Boolean(most) && KINDS.some((kind) => has[kind] >= most[kind]);
}
