// History of values with undo and redo. Values share what they have in common, so that 500 of them are small.

export const MAX_UNDO = 500;

/** @template T */
export class History {
  /** @param {T} first */
  constructor(first) {
    /** @type {T[]} */
    this.past = [];
    this.present = first;
    /** @type {T[]} */
    this.future = [];
    /** @type {T | null} what a gesture that goes on would make of it */
    this.preview = null;
  }

  /** Shown value: the one of the gesture that goes on, or the current one. */
  get shown() {
    return this.preview ?? this.present;
  }

  /** Adds a step that can be undone, whatever was previewed. Does nothing where the value is the current one. @param {T} next */
  commit(next) {
    this.preview = null;
    if (next === this.present) return;
    this.past.push(this.present);
    if (this.past.length > MAX_UNDO) this.past.shift();
    this.present = next;
    this.future = [];
  }

  /** Ends a gesture without a step. */
  cancel() {
    this.preview = null;
  }

  undo() {
    this.preview = null;
    const before = this.past.pop();
    if (before === undefined) return false;
    this.future.push(this.present);
    this.present = before;
    return true;
  }

  redo() {
    this.preview = null;
    const next = this.future.pop();
    if (next === undefined) return false;
    this.past.push(this.present);
    this.present = next;
    return true;
  }
}
