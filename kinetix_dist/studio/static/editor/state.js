// State of the editor and the actions of a person: level, history, selection, tool, view. Pages and tests drive this.
import { documentText, newLevel, parsePath, elementAt } from "./document.js";
import { stillThere } from "./edits.js";
import { History } from "./history.js";

/**
 * @typedef {import("./document.js").Level} Level
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {{ document: Level, file: string | null }} State what undo brings back; file: of the command line, that it is saved to
 * @typedef {{ kind: "rectangle", from: Point, to: Point } | { kind: "corners", points: Point[], to: Point | null } | { kind: "line", from: Point, to: Point }} Sketch
 */

const SMALLEST_VIEW_M = 0.3;
const LARGEST_VIEW_M = 30;
/** metres: along the shorter side of the picture. @type {{ middle: Point, metres: number }} */
export const WHOLE_VIEW = { middle: [2.5, 2.5], metres: 5.5 };

export class Editor {
  /** @param {import("../world/display_list.js").Engine} engine */
  constructor(engine) {
    this.engine = engine;
    /** @type {History<State>} */
    this.history = new History({ document: newLevel(), file: null });
    /** @type {string[]} */
    this.selection = [];
    this.tool = "select";
    this.snaps = true;
    this.adds = false; // clicks add to the selection: what shift does, for fingers
    /** @type {{ middle: Point, metres: number }} */
    this.view = { ...WHOLE_VIEW };
    this.note = "";
    /** What a button next to the note does about it. @type {{ label: string, run: () => void } | null} */
    this.remedy = null;
    /** Where a click of the tool would land. @type {import("./joining.js").Landing | null} */
    this.hover = null;
    /** @type {Sketch | null} */
    this.sketch = null;
    /** @type {{ axis: 0 | 1, at: number }[]} */
    this.guides = [];
    /** @type {Point | null} where the keyboard points */
    this.cursor = null;
    /** Contents of files when they were read or saved. @type {Map<string, { hash: string | null, text: string }>} */
    this.files = new Map();
    /** The level that came from a run's buffer: while it is as it came, its stored arrays are played, which a document
     * gives to an ulp. @type {{ text: string, level: { run: string, index: number, [kind: string]: any } } | null} */
    this.stored = null;
    /** @type {Set<() => void>} */
    this.listeners = new Set();
  }

  /** The level as the engine worker calls it. */
  get given() {
    const isStored = this.stored !== null && this.stored.text === documentText(this.settled);
    return isStored && this.stored ? this.stored.level : { document: this.settled };
  }

  get document() {
    return this.history.shown.document;
  }

  /** As it was before the gesture that goes on. */
  get settled() {
    return this.history.present.document;
  }

  get file() {
    return this.history.shown.file;
  }

  get walls() {
    return this.engine.walls;
  }

  changed() {
    for (const listener of this.listeners) listener();
  }

  /** Shows what a gesture would make. @param {Level} document */
  preview(document) {
    this.history.preview = { ...this.history.present, document };
    this.changed();
  }

  /** Adds a step of the history. @param {Level} document @param {string[]} [selection] @param {string | null} [file] */
  commit(document, selection, file = this.history.present.file) {
    const before = this.history.present;
    if (document !== before.document || file !== before.file) {
      const isSame = file === before.file && documentText(document) === documentText(before.document);
      this.history.commit(isSame ? before : { document, file });
    }
    this.history.cancel();
    this.selection = stillThere(document, selection ?? this.selection);
    this.endSketch();
    this.changed();
  }

  /** Ends a gesture without a trace. */
  cancel() {
    this.history.cancel();
    this.endSketch();
    this.changed();
  }

  endSketch() {
    this.sketch = this.hover = null;
    this.guides = [];
  }

  undo() {
    this.#travel(this.history.undo());
  }

  redo() {
    this.#travel(this.history.redo());
  }

  /** @param {boolean} hasMoved */
  #travel(hasMoved) {
    this.endSketch();
    this.selection = stillThere(this.document, this.selection);
    this.notify(hasMoved ? "" : "nothing more");
  }

  /** @param {string[]} selection */
  select(selection) {
    this.selection = [...new Set(stillThere(this.document, selection))];
    this.changed();
  }

  /** @param {string} tool */
  use(tool) {
    this.history.cancel();
    this.endSketch();
    this.tool = tool;
    this.notify("");
  }

  /** Shows a line below the picture. @param {string} note @param {Editor["remedy"]} [remedy] */
  notify(note, remedy = null) {
    this.note = note;
    this.remedy = remedy;
    this.changed();
  }

  /** Another level, as a step that can be undone. @param {Level} document @param {{ file?: string | null, hash?: string | null }} [from] */
  open(document, { file = null, hash = null } = {}) {
    if (file !== null) this.files.set(file, { hash, text: documentText(document) });
    this.view = { ...WHOLE_VIEW };
    this.commit(document, [], file);
  }

  /** True where the file of the command line has another content. */
  get isUnsaved() {
    const known = this.file === null ? undefined : this.files.get(this.file);
    return !known || known.hash === null || known.text !== documentText(this.document);
  }

  /** Selects what a problem or a warning is about. @param {readonly string[]} paths of elements, or of fields of them */
  show(paths) {
    const elements = paths.flatMap((path) => {
      const found = parsePath(path);
      if (!found) return [];
      return [found.part === "walls" ? `walls.${found.name}` : `${found.part}[${found.index}]`];
    });
    if (!elements.some((path) => elementAt(this.document, path) !== undefined)) return;
    this.use("select");
    this.select(elements);
  }

  /** @param {number} factor below 1: nearer @param {Point} about this point stays where it is */
  zoom(factor, about) {
    const metres = Math.min(Math.max(this.view.metres * factor, SMALLEST_VIEW_M), LARGEST_VIEW_M);
    const share = metres / this.view.metres;
    const [x, y] = this.view.middle;
    this.view = { metres, middle: [about[0] + (x - about[0]) * share, about[1] + (y - about[1]) * share] };
    this.changed();
  }

  /** @param {Point} step m */
  pan(step) {
    const [x, y] = this.view.middle;
    this.view = { ...this.view, middle: [x - step[0], y - step[1]] };
    this.changed();
  }
}
