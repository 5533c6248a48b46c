// A language that `Intl` takes, before a library uses it: a browser without one set (LANG=C) says "en-US@posix", and
// uPlot throws on that where it is loaded. Nothing is changed in browsers whose language is a valid tag.

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
