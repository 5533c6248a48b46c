// Rows of the evaluation page: levels with their counts in each evaluation, changes, sorting and filtering. Draws nothing.

/** @type {Record<string, string>} */
export const PHASES = { random_policy: "random", before: "before", training: "", after: "after" };
/** Orders of levels by their names in the address. @type {Record<string, string>} */
export const SORTS = {
  least: "least solved now",
  lost: "lost most since the last evaluation",
  lost_first: "lost most since the first evaluation",
  lost_best: "lost most since the best evaluation",
  name: "by name",
};
/** Changes that an order goes by. @type {Record<string, "last" | "first" | "best">} */
const CHANGE_OF_SORT = { lost: "last", lost_first: "first", lost_best: "best" };

/**
 * @typedef {{ solved: number, attempts: number, rate: number, low: number, high: number }} Counts
 * @typedef {{ value: number, low: number, high: number, from: string }} Change from: the evaluation that it is against
 * @typedef {{ phase: string, update: number, label: string }} Column an evaluation
 * @typedef {object} Row
 * @property {string} key of the level in the address: its name, with set and number where that is not enough
 * @property {string} set
 * @property {number} index in its set
 * @property {string} name
 * @property {(Counts | null)[]} cells one for each column
 * @property {Counts | null} now newest evaluation of the policy
 * @property {Counts | null} before first evaluation of the policy; null where there is one only
 * @property {Record<"last" | "first" | "best", Change> | null} changes
 * @property {Record<string, number> | null} features null: not known (yet)
 */

/** @param {any} point @returns {string} */
export function labelOf(point) {
  return PHASES[point.phase] || String(point.update);
}

/** Evaluations of sets, in the order in which they happened. @param {any} data @param {string[]} sets @returns {Column[]} */
export function columnsOf(data, sets) {
  const order = Object.keys(PHASES);
  /** @type {Map<string, Column>} */
  const found = new Map();
  for (const name of sets) for (const point of data.sets[name].points) found.set(keyOf(point), { phase: point.phase, update: point.update, label: labelOf(point) });
  return [...found.values()].sort((a, b) => order.indexOf(a.phase) - order.indexOf(b.phase) || a.update - b.update);
}

/**
 * Rows of all levels of sets that have counts of single levels.
 * @param {any} data @param {string[]} sets @param {Column[]} columns @param {Record<string, any>} features answers by set
 * @returns {Row[]}
 */
export function rowsOf(data, sets, columns, features) {
  /** @type {Map<string, number>} */
  const uses = new Map();
  for (const name of sets) for (const level of data.sets[name].names ?? []) uses.set(level, (uses.get(level) ?? 0) + 1);
  return sets.flatMap((set) => {
    const { names, points, changes } = data.sets[set];
    if (!names) return [];
    const pointOf = new Map(points.map((/** @type {any} */ point, /** @type {number} */ k) => [keyOf(point), k]));
    const ofPolicy = [...points.keys()].filter((k) => points[k].phase !== "random_policy" && points[k].attempts);
    const places = columns.map((column) => pointOf.get(keyOf(column)));
    const known = features[set]?.features;
    const seen = new Map();
    return names.map((/** @type {string} */ name, /** @type {number} */ index) => {
      const counts = (/** @type {number | undefined} */ k) => (k === undefined ? null : countsOf(points[k], index, data.intervals));
      const number = (seen.get(name) ?? 0) + 1; // of levels of this name in the set
      seen.set(name, number);
      return {
        key: uses.get(name) === 1 ? name : `${set}/${name}${number > 1 ? `~${number}` : ""}`,
        set, index, name,
        cells: places.map(counts),
        now: counts(ofPolicy.at(-1)),
        before: ofPolicy.length > 1 ? counts(ofPolicy[0]) : null,
        changes: changes && Object.fromEntries(Object.entries(changes).map(([kind, one]) => [kind, { value: one.value[index], low: one.low[index], high: one.high[index], from: labelOf(points[one.points[index]]) }])),
        features: known ? Object.fromEntries(Object.entries(known).map(([feature, values]) => [feature, values[index]])) : null,
      };
    });
  });
}

/** @param {any} point @param {number} level @param {Record<string, [number, number][]>} intervals @returns {Counts | null} */
function countsOf(point, level, intervals) {
  if (!point.attempts) return null;
  const solved = point.solved[level];
  const [low, high] = intervals[point.attempts][solved];
  return { solved, attempts: point.attempts, rate: solved / point.attempts, low, high };
}

/** @param {{ phase: string, update: number }} point */
function keyOf(point) {
  return `${point.phase} ${point.update}`;
}

/** @param {string} sort */
export function changeOfSort(sort) {
  return CHANGE_OF_SORT[sort] ?? "first";
}

/** Rows in an order; levels without what it goes by come last. @param {Row[]} rows @param {string} sort @returns {Row[]} */
export function sorted(rows, sort) {
  const byName = (/** @type {Row} */ a, /** @type {Row} */ b) => a.name.localeCompare(b.name, "en", { numeric: true });
  const value = (/** @type {Row} */ row) => (sort === "least" ? row.now?.rate : row.changes?.[changeOfSort(sort)].value) ?? Infinity;
  return [...rows].sort(sort === "name" ? byName : (a, b) => (value(a) === value(b) ? 0 : value(a) - value(b)) || byName(a, b));
}

const CONDITION = /^(\w+)(<=|>=|=|<|>)(-?\d+(?:\.\d+)?)$/;
/** @type {Record<string, (a: number, b: number) => boolean>} */
const COMPARE = { "<": (a, b) => a < b, "<=": (a, b) => a <= b, "=": (a, b) => a === b, ">=": (a, b) => a >= b, ">": (a, b) => a > b };

/**
 * Rows that a filter names: parts of names, and conditions such as joints>=2, now<0.5, lost>0.2 (since the first).
 * @param {Row[]} rows @param {string} text
 * @returns {{ rows: Row[], problem: string | null }} problem: why a condition was left out
 */
export function filtered(rows, text) {
  const words = text.trim().split(/\s+/).filter(Boolean);
  let problem = null;
  /** @type {((row: Row) => boolean)[]} */
  const tests = [];
  for (const word of words) {
    const [, name, compare, number] = CONDITION.exec(word) ?? [];
    if (!name) {
      tests.push((row) => row.name.toLowerCase().includes(word.toLowerCase()));
      continue;
    }
    const known = rows.find((row) => row.features)?.features;
    if (!["now", "before", "lost"].includes(name) && !(known && name in known)) {
      problem = known ? `the filter names ${name}; there are now, before, lost, ${Object.keys(known).join(", ")}` : `${word}: features of these levels are not known (yet)`;
      continue;
    }
    tests.push((row) => {
      const value = valueOf(row, name);
      return value !== undefined && COMPARE[compare](value, Number(number));
    });
  }
  return { rows: rows.filter((row) => tests.every((test) => test(row))), problem };
}

/** @param {Row} row @param {string} name @returns {number | undefined} */
function valueOf(row, name) {
  if (name === "now") return row.now?.rate;
  if (name === "before") return row.before?.rate;
  if (name === "lost") return row.changes ? -row.changes.first.value : undefined;
  return row.features?.[name];
}
