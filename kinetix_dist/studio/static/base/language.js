// Words of the pages: numbers with their nouns, times ago. And a language that `Intl` takes, before a library uses it: a
// browser without one set (LANG=C) says "en-US@posix", and uPlot throws on that where it is loaded. Nothing is changed in
// browsers whose language is a valid tag.

/** The form of a noun for a number: "level" of 1, "levels" of others. @param {number} number @param {string} one
 * @param {string} [others] */
export function noun(number, one, others = `${one}s`) {
  return number === 1 ? one : others;
}

/** "1 level", "2 levels". @param {number} number @param {string} one @param {string} [others] */
export function count(number, one, others) {
  return `${number} ${noun(number, one, others)}`;
}

/** "21 min ago" @param {number} seconds that have passed */
export function ago(seconds) {
  if (seconds < 10) return "just now";
  if (seconds < 120) return `${Math.round(seconds)} s ago`;
  if (seconds < 7200) return `${Math.round(seconds / 60)} min ago`;
  if (seconds < 172800) return `${Math.round(seconds / 3600)} h ago`;
  return `${Math.round(seconds / 86400)} days ago`;
}

/** The longest valid beginning of a language tag; "en-US" where there is none. @param {string} given */
export function validLanguage(given) {
  const [plain] = given.split(/[@.]/);
  for (const tag of [given, plain, plain.replaceAll("_", "-")]) {
    try {
      if (Intl.getCanonicalLocales(tag).length) return tag;
    } catch (error) {
      if (!(error instanceof RangeError)) throw error;
    }
  }
  return "en-US";
}

const valid = validLanguage(navigator.language ?? "");
if (valid !== navigator.language) Object.defineProperty(navigator, "language", { value: valid, configurable: true });
