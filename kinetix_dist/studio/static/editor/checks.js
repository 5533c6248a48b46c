// Checks of the level by the engine worker while it is changed: problems, warnings, facts. Only the newest counts.
import { channel } from "../base/channel.js";

const WAIT_MS = 120; // after a change; a drag is not checked at every pixel
const PLAY_WAIT_MS = 700; // until the level is tested for solving itself

/**
 * @typedef {{ path: string, paths: string[], problem: string, remedy: string, missing_role: string | null }} Problem
 * @typedef {{ problems: Problem[], numProblems: number, warnings: { kind: string, paths: string[], text: string }[], facts: any,
 *   isCurrent: boolean, error: string }} Checked
 */

export class Checks {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    /** @type {Checked} */
    this.checked = { problems: [], numProblems: 0, warnings: [], facts: null, isCurrent: false, error: "" };
    /** @type {any} */
    this.document = null;
    this.timer = 0;
    this.milliseconds = 0; // of the last reply
  }

  /** Result for a level; `isCurrent` is false where it is not the one that was checked last. @param {any} document */
  of(document) {
    return document === this.document ? this.checked : { ...this.checked, isCurrent: false };
  }

  /** @param {any} document */
  request(document) {
    if (document === this.document) return;
    this.document = document;
    this.checked = { ...this.checked, isCurrent: false };
    clearTimeout(this.timer);
    this.timer = window.setTimeout(() => void this.#check(document, false), WAIT_MS);
    this.changed();
  }

  /** @param {any} document @param {boolean} play */
  async #check(document, play) {
    const began = performance.now();
    try {
      const answer = await channel.request("check", { document, play });
      if (document !== this.document) return;
      this.milliseconds = performance.now() - began;
      this.checked = { problems: answer.problems, numProblems: answer.num_problems, warnings: answer.warnings, facts: answer.facts, isCurrent: true, error: "" };
      if (!play && answer.facts) this.timer = window.setTimeout(() => void this.#check(document, true), PLAY_WAIT_MS);
    } catch (error) {
      if (document !== this.document) return;
      this.checked = { problems: [], numProblems: 0, warnings: [], facts: null, isCurrent: true, error: error instanceof Error ? error.message : String(error) };
      this.timer = window.setTimeout(() => {
        this.document = null; // checked again with the next change, or when connected
        this.request(document);
      }, 3000);
    }
    this.changed();
  }

  end() {
    clearTimeout(this.timer);
    this.document = null;
  }
}
