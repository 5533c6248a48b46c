// Everything that a key or a button does at once. The bar, the keyboard and the help are made from this list.
import { elementAt, withElement } from "./document.js";
import { aligned, copied, distributed, everything, joined, mirrored, moved, pasted, rolesTaken, turned, withRole, without } from "./edits.js";
import { FIXED, isFixed, withValue } from "./fields.js";
import { landingWords } from "./joining.js";
import { GRID_M, TURN_RAD } from "./snap.js";
import { WHOLE_VIEW } from "./state.js";
import { TOOLS } from "./tools.js";

/**
 * @typedef {import("./state.js").Editor} Editor
 * @typedef {{ keys: string[], label: string, icon?: string, role?: string, run: (editor: Editor, key: string) => void }} Command keys: "ctrl+z";
 *   icon: of its button; role: that it gives
 */

/** @type {import("./edits.js").Copied | null} */
let clipboard = null;
/** @param {import("./edits.js").Copied} part */
export const setClipboard = (part) => {
  clipboard = part;
};

const STEP_M = GRID_M / 2;
const FINE_M = 0.005;
const FINE_RAD = Math.PI / 180;
/** @type {Record<string, import("./geometry.js").Point>} */
const DIRECTIONS = { arrowleft: [-1, 0], arrowright: [1, 0], arrowup: [0, 1], arrowdown: [0, -1] };

/** @param {Editor} editor @param {import("./edits.js").Copied} part */
export function paste(editor, part) {
  const { document, selection } = pasted(editor.settled, part, [2 * GRID_M, 2 * GRID_M], editor.walls);
  editor.commit(document, selection);
}

/** Arrow keys move what is selected; where a tool draws, or nothing is selected, the cross that Enter clicks with.
 * @param {Editor} editor @param {string} key */
function arrow(editor, key) {
  const [dx, dy] = DIRECTIONS[key.replace("shift+", "")];
  const step = key.startsWith("shift+") ? FINE_M : STEP_M;
  if (editor.tool === "select" && editor.selection.length && !editor.cursor) {
    editor.commit(moved(editor.settled, editor.selection, [dx * step, dy * step], editor.walls));
    return;
  }
  const [x, y] = editor.cursor ?? editor.view.middle;
  editor.cursor = [x + dx * step, y + dy * step];
  const landing = TOOLS[editor.tool].hover?.(editor, cursorPointer(editor));
  const words = landing ? `: ${landingWords(editor, landing)}` : "";
  editor.notify(`${editor.cursor[0].toFixed(3)}, ${editor.cursor[1].toFixed(3)} m${words}`);
}

/** The cross as a pointer. @param {Editor} editor @returns {import("./pointing.js").Pointer} */
export const cursorPointer = (editor) => ({ at: editor.cursor ?? editor.view.middle, px: 0.01, thick: 1, add: false, free: true });

/** Click with the cross. @param {Editor} editor */
function click(editor) {
  const pointer = cursorPointer(editor);
  TOOLS[editor.tool].down(editor, pointer)?.up(pointer);
}

/** Gives shapes or walls a role. Green and blue are of one shape: the one that had it has none then.
 * @param {Editor} editor @param {readonly string[]} paths @param {string} role */
export function giveRole(editor, paths, role) {
  const holders = paths.filter((path) => /^(shapes|walls)/.test(path));
  if (!holders.length) return editor.notify("select a shape or a wall first, then its role");
  if (holders.length > 1 && (role === "green" || role === "blue")) return editor.notify(`one shape of a level is ${role}: select one`);
  const others = rolesTaken(editor.settled, role, holders);
  editor.commit(withRole(editor.settled, holders, role));
  return editor.notify(others.length ? `${role} is one shape: ${others.join(", ")} ${others.length > 1 ? "have" : "has"} no role now` : "");
}

/** Fixes the selected shapes where they are; where all of them are fixed, they may move again. @param {Editor} editor */
function fix(editor) {
  const shapes = editor.selection.filter((path) => path.startsWith("shapes"));
  if (!shapes.length) return editor.notify("select a shape first; walls are fixed anyway");
  const areFixed = shapes.every((path) => isFixed(elementAt(editor.settled, path)));
  editor.commit(shapes.reduce((level, path) => withElement(level, path, withValue(elementAt(level, path), FIXED, !areFixed)), editor.settled));
  return editor.notify(areFixed ? "it moves" : "it is fixed: it never moves");
}

/** Selects the next element, or the one before. @param {Editor} editor @param {number} by */
function next(editor, by) {
  const all = everything(editor.settled);
  if (!all.length) return;
  const now = all.indexOf(editor.selection[0]);
  editor.cursor = null;
  editor.select([all[(now + by + (now < 0 && by < 0 ? 1 : 0) + all.length) % all.length]]);
}

/** @param {Editor} editor @param {(document: import("./document.js").Level) => import("./document.js").Level} change */
const changed = (editor, change) => editor.commit(change(editor.settled));

/** @type {Command[]} */
export const COMMANDS = [
  { keys: ["ctrl+z"], label: "Undo", icon: "undo", run: (editor) => editor.undo() },
  { keys: ["ctrl+y", "ctrl+shift+z"], label: "Redo", icon: "redo", run: (editor) => editor.redo() },
  { keys: ["ctrl+c"], label: "Copy", icon: "copy", run: (editor) => setClipboard(copied(editor.settled, editor.selection)) },
  { keys: ["ctrl+v"], label: "Paste", icon: "paste", run: (editor) => (clipboard ? paste(editor, clipboard) : editor.notify("nothing was copied")) },
  { keys: ["ctrl+x"], label: "Cut", run: (editor) => { setClipboard(copied(editor.settled, editor.selection)); editor.commit(without(editor.settled, editor.selection), []); } },
  { keys: ["ctrl+d"], label: "Duplicate", icon: "double", run: (editor) => paste(editor, copied(editor.settled, editor.selection)) },
  { keys: ["delete", "backspace"], label: "Delete", icon: "delete", run: (editor) => editor.commit(without(editor.settled, editor.selection), []) },
  { keys: ["ctrl+a"], label: "Select all", run: (editor) => editor.select(everything(editor.settled)) },
  { keys: ["g"], label: "Select joined", icon: "joined", run: (editor) => editor.select(joined(editor.settled, editor.selection)) },
  { keys: ["tab"], label: "Next element", run: (editor) => next(editor, 1) },
  { keys: ["shift+tab"], label: "Element before", run: (editor) => next(editor, -1) },
  { keys: ["m"], label: "Mirror", icon: "mirror", run: (editor) => changed(editor, (level) => mirrored(level, editor.selection, editor.walls)) },
  { keys: ["shift+g"], label: "Role green", role: "green", run: (editor) => giveRole(editor, editor.selection, "green") },
  { keys: ["shift+b"], label: "Role blue", role: "blue", run: (editor) => giveRole(editor, editor.selection, "blue") },
  { keys: ["shift+r"], label: "Role red", role: "red", run: (editor) => giveRole(editor, editor.selection, "red") },
  { keys: ["shift+n"], label: "Role none", role: "none", run: (editor) => giveRole(editor, editor.selection, "none") },
  { keys: ["shift+f"], label: "Fixed, or free to move", icon: "pin", run: fix },
  { keys: ["["], label: "Turn left 15°", run: (editor) => changed(editor, (level) => turned(level, editor.selection, TURN_RAD, editor.walls)) },
  { keys: ["]"], label: "Turn right 15°", run: (editor) => changed(editor, (level) => turned(level, editor.selection, -TURN_RAD, editor.walls)) },
  { keys: ["{"], label: "Turn left 1°", run: (editor) => changed(editor, (level) => turned(level, editor.selection, FINE_RAD, editor.walls)) },
  { keys: ["}"], label: "Turn right 1°", run: (editor) => changed(editor, (level) => turned(level, editor.selection, -FINE_RAD, editor.walls)) },
  .../** @type {const} */ (["left", "right", "top", "bottom", "centre", "middle"]).map((how) => ({
    keys: [`alt+${{ left: "l", right: "r", top: "t", bottom: "b", centre: "c", middle: "m" }[how]}`],
    label: `Align ${how}`,
    run: (/** @type {Editor} */ editor) => changed(editor, (level) => aligned(level, editor.selection, how, editor.walls)),
  })),
  { keys: ["alt+h"], label: "Distribute from left to right", run: (editor) => changed(editor, (level) => distributed(level, editor.selection, 0, editor.walls)) },
  { keys: ["alt+v"], label: "Distribute from bottom to top", run: (editor) => changed(editor, (level) => distributed(level, editor.selection, 1, editor.walls)) },
  { keys: Object.keys(DIRECTIONS), label: "Move by 5 cm, or the cross", run: arrow },
  { keys: Object.keys(DIRECTIONS).map((key) => `shift+${key}`), label: "Move by 5 mm, or the cross", run: arrow },
  { keys: ["enter"], label: "Click with the cross", run: click },
  { keys: ["escape"], label: "End the gesture, then the selection", run: (editor) => { const isIdle = !editor.sketch && !editor.cursor && editor.tool === "select"; editor.cursor = null; editor.use("select"); if (isIdle) editor.select([]); } },
  { keys: ["+", "="], label: "Nearer", icon: "nearer", run: (editor) => editor.zoom(1 / 1.25, editor.view.middle) },
  { keys: ["-"], label: "Farther", icon: "farther", run: (editor) => editor.zoom(1.25, editor.view.middle) },
  { keys: ["0"], label: "Whole box", icon: "whole", run: (editor) => { editor.view = { ...WHOLE_VIEW }; editor.changed(); } },
  { keys: ["n"], label: "Snap on or off", icon: "snap", run: (editor) => { editor.snaps = !editor.snaps; editor.notify(`snapping ${editor.snaps ? "on" : "off"}`); } },
  ...Object.entries(TOOLS).map(([name, tool]) => ({ keys: [tool.key], label: `Tool: ${tool.label}`, run: (/** @type {Editor} */ editor) => editor.use(name) })),
];

/** "ctrl+shift+z" of an event. @param {KeyboardEvent} event */
export function keyOf(event) {
  const key = event.key.toLowerCase();
  const isSign = key.length === 1 && !/[a-z0-9]/.test(key); // shift is in it already
  return `${event.ctrlKey || event.metaKey ? "ctrl+" : ""}${event.altKey ? "alt+" : ""}${event.shiftKey && !isSign ? "shift+" : ""}${key}`;
}

/** @param {string} key @returns {Command | undefined} */
export const commandOf = (key) => COMMANDS.find((command) => command.keys.includes(key));
