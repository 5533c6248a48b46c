// Tools: what a pointer that goes down, moves and goes up makes of the level. A gesture is one step of the history.
import { added, boundsOf, jointEnds, newId, parsePath, shapesOf, elementAt, thrusterPlace, toLocal } from "./document.js";
import { moved, selectedShapes } from "./edits.js";
import { distance, hull, rounded, roundedPoint, sub, wrapped } from "./geometry.js";
import { bodiesNear, dragged, handlesOf, isConvex, thingsAt } from "./handles.js";
import { joining, landingOf } from "./joining.js";
import { aimed, CLICK_PX, THING_PX } from "./pointing.js";
import { snappedAngle } from "./snap.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("./state.js").Editor} Editor
 * @typedef {import("./pointing.js").Pointer} Pointer
 * @typedef {import("./pointing.js").Gesture} Gesture
 * @typedef {{ key: string, label: string, help: string, down: (editor: Editor, pointer: Pointer) => Gesture | null,
 *   hover?: (editor: Editor, pointer: Pointer) => import("./joining.js").Landing }} Tool hover: where a click would land
 */

const HANDLE_PX = 12; // how near a pointer has to come, times how thick it is
const DEFAULT_M = 0.5; // side of a box that is placed by a click

/** @param {Editor} editor @param {Pointer} pointer @returns {Gesture} */
function beginSelect(editor, pointer) {
  const before = editor.settled;
  const handles = handlesOf(before, editor.selection, editor.walls, pointer.px);
  const held = handles.findIndex((handle) => distance(handle.at, pointer.at) <= HANDLE_PX * pointer.px * pointer.thick);
  if (held >= 0) {
    const handle = handles[held];
    const number = handles.slice(0, held).filter((entry) => entry.kind === handle.kind).length;
    return dragHandle(editor, handle, number, pointer);
  }
  const under = thingsAt(before, pointer.at, THING_PX * pointer.px * pointer.thick, editor.walls);
  const isSelected = under.find((path) => editor.selection.includes(path));
  const [top] = under;
  if (pointer.add && top) {
    const others = editor.selection.filter((path) => path !== top);
    editor.select(others.length < editor.selection.length ? others : [...others, top]);
    return { move: () => {}, up: () => {} };
  }
  if (!top || (top.startsWith("walls.") && !isSelected)) return dragRectangle(editor, pointer, top);
  const before_selection = editor.selection;
  if (!isSelected) editor.select([top]);
  return dragThings(editor, pointer, () => {
    // A click on what was selected goes on to what lies below it.
    if (!isSelected) return;
    if (before_selection.length > 1) editor.select([top]);
    else editor.select([under[(under.indexOf(isSelected) + 1) % under.length]]);
  });
}

/** @param {Editor} editor @param {import("./handles.js").Handle} handle @param {number} number @param {Pointer} start @returns {Gesture} */
function dragHandle(editor, handle, number, start) {
  const before = editor.settled;
  const selection = [...editor.selection];
  const only = parsePath(selection[0]);
  const but = new Set(only?.part === "shapes" ? [before.shapes[only.index].id] : []);
  const isPoint = ["corner", "vertex", "radius"].includes(handle.kind);
  let hasMoved = false;
  return {
    move(pointer) {
      hasMoved ||= distance(pointer.at, start.at) > CLICK_PX * pointer.px * pointer.thick;
      if (!hasMoved) return;
      const snaps = editor.snaps && !pointer.free;
      const point = isPoint ? aimed(editor, pointer, but) : pointer.at;
      const after = dragged(before, selection, handle, number, point, snaps, editor.walls);
      if (after) editor.preview(after);
    },
    up: () => editor.commit(editor.document),
  };
}

/** Position of a joint or a thruster. @param {Editor} editor @param {string} path @returns {Point | null} */
function placeOf({ settled, walls }, path) {
  const element = elementAt(settled, path);
  if (path.startsWith("joints")) return jointEnds(settled, element, walls)?.[0] ?? null;
  return path.startsWith("thrusters") ? (thrusterPlace(settled, element)?.at ?? null) : null;
}

/** @param {Editor} editor @param {Pointer} start @param {() => void} clicked @returns {Gesture} */
function dragThings(editor, start, clicked) {
  const before = editor.settled;
  const selection = [...editor.selection];
  const indices = selectedShapes(before, selection);
  const ids = new Set(indices.map((index) => before.shapes[index].id));
  const first = indices.length ? before.shapes[indices[0]].position : placeOf(editor, selection[0]);
  let hasMoved = false;
  return {
    move(pointer) {
      hasMoved ||= distance(pointer.at, start.at) > CLICK_PX * pointer.px * pointer.thick;
      if (!hasMoved) return;
      if (!first) return; // walls stay where they are
      const [dx, dy] = sub(pointer.at, start.at);
      const target = aimed(editor, { ...pointer, at: [first[0] + dx, first[1] + dy] }, ids);
      editor.preview(moved(before, selection, sub(target, first), editor.walls));
    },
    up() {
      if (hasMoved) editor.commit(editor.document);
      else clicked();
    },
  };
}

/** @param {Editor} editor @param {Pointer} start @param {string | undefined} wall that was clicked @returns {Gesture} */
function dragRectangle(editor, start, wall) {
  const before = start.add ? editor.selection : [];
  let hasMoved = false;
  return {
    move(pointer) {
      hasMoved ||= distance(pointer.at, start.at) > CLICK_PX * pointer.px * pointer.thick;
      if (!hasMoved) return;
      editor.sketch = { kind: "rectangle", from: start.at, to: pointer.at };
      const [left, right] = [start.at[0], pointer.at[0]].sort((a, b) => a - b);
      const [bottom, top] = [start.at[1], pointer.at[1]].sort((a, b) => a - b);
      const inside = editor.document.shapes.flatMap((shape, index) => {
        if (!shapesOf(editor.document).includes(shape)) return [];
        const [x0, y0, x1, y1] = boundsOf(shape);
        return x0 >= left && x1 <= right && y0 >= bottom && y1 <= top ? [`shapes[${index}]`] : [];
      });
      editor.select([...before, ...inside]);
    },
    up() {
      editor.endSketch();
      if (!hasMoved) editor.select(wall ? [...before, wall] : before);
      editor.changed();
    },
  };
}

/** A shape is drawn by dragging, or placed by a click. @param {string} kind
 * @param {(from: Point, to: Point) => Record<string, any> | null} make what a drag makes; null: too small
 * @param {(at: Point) => Record<string, any>} place what a click makes @returns {Tool["down"]} */
function drawing(kind, make, place) {
  return (editor, start) => {
    const before = editor.settled;
    const from = aimed(editor, start);
    const withShape = (/** @type {Record<string, any>} */ shape) => added(before, "shapes", /** @type {any} */ ({ id: newId(before, kind), ...shape }));
    return {
      move(pointer) {
        const shape = make(from, aimed(editor, pointer));
        if (shape) editor.preview(withShape(shape));
      },
      up(pointer) {
        const isClick = distance(pointer.at, start.at) <= CLICK_PX * pointer.px * pointer.thick;
        const shape = isClick ? place(from) : make(from, aimed(editor, pointer));
        if (!shape) return editor.cancel();
        editor.commit(withShape(shape), [`shapes[${before.shapes.length}]`]);
      },
    };
  };
}

/** Corners are clicked one after another; the hull of them is the shape. @param {string} kind @param {number} count @returns {Tool["down"]} */
function clicking(kind, count) {
  return (editor, start) => {
    const points = editor.sketch?.kind === "corners" ? editor.sketch.points : [];
    const show = (/** @type {Pointer} */ pointer) => {
      editor.sketch = { kind: "corners", points, to: aimed(editor, pointer) };
      editor.changed();
    };
    show(start);
    return {
      move: show,
      up(pointer) {
        const all = [...points, aimed(editor, pointer)];
        const first = all.length > 1 && distance(all[0], all[all.length - 1]) < 1e-6;
        if (first) return editor.notify("this corner is there already");
        if (all.length < count) {
          editor.sketch = { kind: "corners", points: all, to: null };
          return editor.notify(`${count - all.length} more corner${count - all.length > 1 ? "s" : ""}`);
        }
        const corners = hull(all);
        const before = editor.settled;
        if (corners.length < 3 || !isConvex(corners)) {
          editor.cancel();
          return editor.notify("these corners lie on a line; click others");
        }
        const middle = roundedPoint(/** @type {Point} */ ([0, 1].map((k) => corners.reduce((sum, corner) => sum + corner[k], 0) / corners.length)));
        const shape = { id: newId(before, kind), type: "polygon", vertices: corners.map((corner) => roundedPoint(sub(corner, middle))), position: middle };
        editor.commit(added(before, "shapes", /** @type {any} */ (shape)), [`shapes[${before.shapes.length}]`]);
        if (corners.length < all.length) editor.notify("one corner lies within the others: the shape is their hull");
      },
    };
  };
}

/** On a shape; a drag gives the direction of the push, a click pushes up. @type {Tool["down"]} */
function beginThruster(editor, start) {
  const before = editor.settled;
  const id = bodiesNear(before, start.at, THING_PX * start.px * start.thick, editor.walls).find(({ path }) => path.startsWith("shapes"))?.path;
  if (!id) {
    editor.notify("a thruster is put on a shape");
    return null;
  }
  const shape = elementAt(before, id);
  const at = aimed(editor, start);
  const path = `thrusters[${(before.thrusters ?? []).length}]`;
  const towards = (/** @type {Pointer} */ pointer) => {
    const isClick = distance(pointer.at, start.at) <= CLICK_PX * pointer.px * pointer.thick;
    const free = isClick ? Math.PI / 2 : Math.atan2(pointer.at[1] - start.at[1], pointer.at[0] - start.at[0]);
    const world = editor.snaps && !pointer.free ? snappedAngle(free) : free;
    const thruster = { shape: shape.id, position: roundedPoint(toLocal(shape, at)), angle: rounded(wrapped(world - (shape.angle ?? 0))), colour: 0 };
    return added(before, "thrusters", thruster);
  };
  return { move: (pointer) => editor.preview(towards(pointer)), up: (pointer) => editor.commit(towards(pointer), [path]) };
}

/** @type {Tool["down"]} */
function beginPan(editor, start) {
  return {
    move: (pointer) => editor.pan(sub(pointer.at, start.at)), // the view moves under the pointer, which then is at the start again
    up: () => {},
  };
}

const box = drawing(
  "box",
  (from, to) => {
    const [width, height] = [Math.abs(to[0] - from[0]), Math.abs(to[1] - from[1])].map(rounded);
    if (width < 0.02 || height < 0.02) return null;
    return { type: "box", width, height, position: roundedPoint([(from[0] + to[0]) / 2, (from[1] + to[1]) / 2]) };
  },
  (position) => ({ type: "box", width: DEFAULT_M, height: DEFAULT_M, position }),
);
const circle = drawing(
  "circle",
  (position, to) => (distance(position, to) < 0.02 ? null : { type: "circle", radius: rounded(distance(position, to)), position }),
  (position) => ({ type: "circle", radius: DEFAULT_M / 2, position }),
);

/** Tools in the order of the bar. @type {Record<string, Tool>} */
export const TOOLS = {
  select: { key: "v", label: "Select", help: "click, shift-click, or drag a rectangle; drag moves; a second click takes what lies below", down: beginSelect },
  box: { key: "b", label: "Box", help: "drag from corner to corner, or click", down: box },
  circle: { key: "c", label: "Circle", help: "drag from the centre, or click", down: circle },
  triangle: { key: "t", label: "Triangle", help: "click three corners", down: clicking("triangle", 3) },
  quadrilateral: { key: "q", label: "Quadrilateral", help: "click four corners", down: clicking("quadrilateral", 4) },
  revolute: { key: "r", label: "Revolute", help: "click where two shapes overlap, or drag from one to another; it has a motor", down: joining("revolute", { hasMotor: true }), hover: landingOf },
  fixed: { key: "f", label: "Fixed", help: "click where two shapes overlap, or drag from one to another", down: joining("fixed"), hover: landingOf },
  prismatic: { key: "l", label: "Slider", help: "click where two shapes overlap, or drag from one to another; its handle turns the axis", down: joining("prismatic", { hasMotor: true, more: { axis: 0 } }), hover: landingOf },
  thruster: { key: "h", label: "Thruster", help: "press on a shape and drag to where it pushes", down: beginThruster },
  pan: { key: "p", label: "Pan", help: "drag; two fingers, the wheel and the middle button do so with any tool", down: beginPan },
};

