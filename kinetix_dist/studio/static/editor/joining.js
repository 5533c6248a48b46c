// Tools that join shapes: where a click or a drag would land, which shapes it would join, and the joint that it makes.
import { added, elementAt, jointEnds, jointsOf } from "./document.js";
import { distance } from "./geometry.js";
import { bodiesNear, nearestPair } from "./handles.js";
import { newMotor } from "./motors.js";
import { aimed, CLICK_PX, THING_PX } from "./pointing.js";

/**
 * @typedef {import("./pointing.js").Point} Point
 * @typedef {import("./pointing.js").Pointer} Pointer
 * @typedef {import("./state.js").Editor} Editor
 * @typedef {{ at: Point, bodies: string[], joint: string | null, why: string }} Landing bodies: paths of a and b; joint: path
 *   of the one that is there already; why: what is missing, "" where a joint can be made
 */

const SAME_PLACE_M = 1e-6;

/** Shapes and walls under a pointer or next to it, the nearest first. @param {Editor} editor @param {Pointer} pointer @param {Point} point */
const bodiesAt = (editor, { px, thick }, point) => bodiesNear(editor.settled, point, THING_PX * px * thick, editor.walls);

/** @param {Editor} editor @param {string} path */
const idOf = (editor, path) => (path.startsWith("walls.") ? path.slice(6) : elementAt(editor.settled, path).id);

/** Where a click would land. A drag from `start` joins the shape there to the one under the pointer.
 * @param {Editor} editor @param {Pointer} pointer @param {Point | null} [start] of a drag @returns {Landing} */
export function landingOf(editor, pointer, start = null) {
  const at = aimed(editor, pointer);
  const [under, from] = [bodiesAt(editor, pointer, pointer.at), bodiesAt(editor, pointer, start ?? pointer.at)];
  // The upper shape is b, as a wheel that is drawn after its chassis.
  const [b, a] = start ? [from[0]?.path, under.find(({ path }) => path !== from[0]?.path)?.path] : nearestPair(editor.settled, from);
  const bodies = [a, b].filter((path) => path !== undefined);
  const joint = jointAt(editor, pointer, at, bodies);
  if (joint) return { at, bodies, joint, why: "" };
  if (bodies.length === 2 && bodies.every((path) => path.startsWith("walls."))) return { at, bodies, joint: null, why: "walls cannot be joined to walls" };
  if (bodies.length === 2) return { at, bodies, joint: null, why: "" };
  if (start) return { at, bodies, joint: null, why: from.length ? "drag on to another shape" : "begin the drag on a shape" };
  return { at, bodies, joint: null, why: bodies.length ? "only one shape here: click where two overlap, or drag to another" : "no shape here: click where two shapes overlap" };
}

/** The joint that is under the pointer, or where it would land. Between other shapes there may be another one.
 * @param {Editor} editor @param {Pointer} pointer @param {Point} at @param {string[]} bodies @returns {string | null} */
function jointAt(editor, pointer, at, bodies) {
  const ids = bodies.map((path) => idOf(editor, path));
  const reach = THING_PX * pointer.px * pointer.thick;
  const found = jointsOf(editor.settled).findIndex((joint) => {
    const isSame = ids.length < 2 || (ids.includes(joint.a) && ids.includes(joint.b));
    return isSame && jointEnds(editor.settled, joint, editor.walls)?.some((end) => distance(end, pointer.at) <= reach || distance(end, at) <= SAME_PLACE_M);
  });
  return found < 0 ? null : `joints[${found}]`;
}

/** Words for what a click would do. @param {Editor} editor @param {Landing} landing */
export function landingWords(editor, { bodies, joint, why }) {
  if (joint) return "a joint is here: a click selects it";
  return why || `joins ${bodies.map((path) => idOf(editor, path)).join(" and ")}`;
}

/** Pressed where two shapes overlap it joins these; dragged from one shape to another, these, where it ends. Where they are
 * joined already it selects their joint.
 * @param {string} type @param {{ hasMotor?: boolean, more?: Record<string, any> }} [options] @returns {import("./tools.js").Tool["down"]} */
export function joining(type, { hasMotor = false, more = {} } = {}) {
  return (editor, start) => {
    const isClick = (/** @type {Pointer} */ pointer) => distance(pointer.at, start.at) <= CLICK_PX * pointer.px * pointer.thick;
    const show = (/** @type {Pointer} */ pointer) => {
      const isDrag = !isClick(pointer);
      editor.hover = landingOf(editor, isDrag ? pointer : start, isDrag ? start.at : null);
      editor.sketch = isDrag ? { kind: "line", from: start.at, to: editor.hover.at } : null;
      editor.changed();
    };
    show(start);
    return {
      move: show,
      up(pointer) {
        const { at, bodies, joint, why } = isClick(pointer) ? landingOf(editor, start) : landingOf(editor, pointer, start.at);
        editor.cancel();
        if (joint) {
          editor.select([joint]);
          return editor.notify("these are joined here already: their joint is selected");
        }
        if (why) return editor.notify(why);
        const before = editor.settled;
        const [a, b] = bodies.map((path) => idOf(editor, path));
        const made = { type, a, b, anchor: at, ...more };
        return editor.commit(added(before, "joints", hasMotor ? { ...made, motor: newMotor(before, made) } : made), [`joints[${jointsOf(before).length}]`]);
      },
    };
  };
}
