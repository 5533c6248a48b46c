// Script of the two pages before the pages: the one that refuses access, and the one that the token leads to. What is behind
// the # of an address (a level, a view) is not sent to a server: this script takes it along from one to the other.
{
  const STORED = "kinetix-dist address"; // in the browser's storage, where another tab finds it
  const LIFETIME_MS = 600_000;
  const { there } = /** @type {HTMLScriptElement} */ (document.currentScript).dataset;

  const stored = () => {
    try {
      const { hash, at } = JSON.parse(localStorage.getItem(STORED) ?? "{}");
      localStorage.removeItem(STORED);
      return Date.now() - at < LIFETIME_MS ? String(hash) : "";
    } catch {
      return ""; // the browser stores nothing: the link has to be opened once more
    }
  };

  const store = () => {
    try {
      localStorage.setItem(STORED, JSON.stringify({ hash: location.hash, at: Date.now() }));
    } catch {} // as above; in this tab the address has it anyway
  };

  /** Goes on with the token of a pasted address. @param {string} text */
  const enter = (text) => {
    const token = /[?&]token=([^&#\s]+)/.exec(text)?.[1] ?? /^\s*([\w-]{16,})\s*$/.exec(text)?.[1];
    if (token) location.href = `./?token=${token}${location.hash}`;
    else /** @type {HTMLElement} */ (document.getElementById("problem")).textContent = "there is no token in this; paste all of the printed address";
  };

  if (there !== undefined) {
    const isLevel = there.includes("level="); // of the command line, which comes first
    location.replace(`./${location.hash || (isLevel ? there : stored() || there)}`);
  } else {
    if (location.hash) store();
    const field = /** @type {HTMLInputElement} */ (document.getElementById("address"));
    field.addEventListener("change", () => enter(field.value));
    document.getElementById("enter")?.addEventListener("click", () => enter(field.value));
  }
}
