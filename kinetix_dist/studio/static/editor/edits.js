// Changes of several elements at once: move, turn, mirror, align, copy, paste, delete, join. All return another document.
import { added, bodyOf, boundsOf, jointEnds, jointsOf, newId, parsePath, PARTS, elementAt, thrustersOf, toLocal, toWorld, withElement } from "./document.js";
import { add, rotate, rounded, roundedPoint, sub, wrapped } from "./geometry.js";

/**
 * @typedef {import("./document.js").Level} Level
 * @typedef {import("./document.js").Wall} Wall
 * @typedef {import("./document.js").Shape} Shape
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {{ format: string, shapes: Shape[], joints: any[], thrusters: any[] }} Copied
 */

export const COPIED_FORMAT = "kinetix-dist-level-part";

/** Shapes of a selection, by their places. @param {Level} document @param {readonly string[]} selection */
export function selectedShapes(document, selection) {
  return selection.flatMap((path) => {
    const found = parsePath(path);
    return found?.part === "shapes" && document.shapes[found.index] ? [found.index] : [];
  });
}

/** The middle of the box around some shapes. @param {Shape[]} shapes @returns {Point} */
export function middleOf(shapes) {
  const boxes = shapes.map(boundsOf);
  const low = [0, 1].map((k) => Math.min(...boxes.map((box) => box[k])));
  const high = [2, 3].map((k) => Math.max(...boxes.map((box) => box[k])));
  return [(low[0] + high[0]) / 2, (low[1] + high[1]) / 2];
}

/**
 * Moves shapes. Joints of two moved shapes and thrusters on them move too; a joint of one
 * that is carried and one that is not stays where it is in the world.
 * @param {Level} document @param {ReadonlySet<string>} ids @param {(shape: Shape) => Shape} carry @param {(point: Point) => Point} place
 * @param {readonly Wall[]} walls @param {{ joint?: (joint: any) => any, thruster?: (thruster: any) => any }} [also]
 * @returns {Level}
 */
function carried(document, ids, carry, place, walls, also = {}) {
  const shapes = document.shapes.map((shape) => (ids.has(shape.id) ? carry(shape) : shape));
  const after = { ...document, shapes };
  const joints = document.joints?.map((joint) => {
    const [movesA, movesB] = [ids.has(joint.a), ids.has(joint.b)];
    if (!movesA && !movesB) return joint;
    if (movesA && movesB) {
      const along = joint.anchor ? { ...joint, anchor: roundedPoint(place(joint.anchor)) } : joint;
      return also.joint ? also.joint(along) : along;
    }
    const ends = jointEnds(document, joint, walls);
    if (joint.anchor || !ends) return joint;
    const [end, at] = movesA ? ["a", ends[0]] : ["b", ends[1]];
    const body = bodyOf(after, joint[end], walls);
    return body ? { ...joint, [`anchor_${end}`]: roundedPoint(toLocal(body, at)) } : joint;
  });
  const thrusters = document.thrusters?.map((thruster) => {
    if (!ids.has(thruster.shape)) return thruster;
    const along = thruster.anchor ? { ...thruster, anchor: roundedPoint(place(thruster.anchor)) } : thruster;
    return also.thruster ? also.thruster(along) : along;
  });
  return { ...after, ...(joints ? { joints } : {}), ...(thrusters ? { thrusters } : {}) };
}

/** @param {Level} document @param {readonly string[]} selection @returns {Set<string>} */
const idsOf = (document, selection) => new Set(selectedShapes(document, selection).map((index) => document.shapes[index].id));

/** Moves by a step, m: shapes with what is on them; joints and thrusters that are selected alone.
 * @param {Level} document @param {readonly string[]} selection @param {Point} step @param {readonly Wall[]} walls @returns {Level} */
export function moved(document, selection, step, walls) {
  const ids = idsOf(document, selection);
  const place = (/** @type {Point} */ point) => add(point, step);
  let after = carried(document, ids, (shape) => ({ ...shape, position: roundedPoint(place(shape.position)) }), place, walls);
  for (const path of selection) {
    const found = parsePath(path);
    if (found?.part === "joints") {
      const joint = jointsOf(document)[found.index];
      const ends = joint && !(ids.has(joint.a) && ids.has(joint.b)) ? jointEnds(document, joint, walls) : null;
      if (ends) after = withAnchor(after, found.index, place(ends[0]), walls);
    } else if (found?.part === "thrusters") {
      const thruster = thrustersOf(document)[found.index];
      const shape = document.shapes.find((entry) => entry.id === thruster?.shape);
      if (thruster && shape && !ids.has(shape.id)) {
        const at = thruster.anchor ?? toWorld(shape, thruster.position ?? [0, 0]);
        after = withThrusterAt(after, found.index, place(at));
      }
    }
  }
  return after;
}

/** A joint whose both ends are at a point of the world. @param {Level} document @param {number} index @param {Point} point
 * @param {readonly Wall[]} walls @returns {Level} */
export function withAnchor(document, index, point, walls) {
  const joint = jointsOf(document)[index];
  if (joint.anchor) return { ...document, joints: jointsOf(document).with(index, { ...joint, anchor: roundedPoint(point) }) };
  const [a, b] = [bodyOf(document, joint.a, walls), bodyOf(document, joint.b, walls)];
  if (!a || !b) return document;
  const held = { ...joint, anchor_a: roundedPoint(toLocal(a, point)), anchor_b: roundedPoint(toLocal(b, point)) };
  return { ...document, joints: jointsOf(document).with(index, held) };
}

/** @param {Level} document @param {number} index @param {Point} point in the world @returns {Level} */
export function withThrusterAt(document, index, point) {
  const thruster = thrustersOf(document)[index];
  const shape = document.shapes.find((entry) => entry.id === thruster.shape);
  if (!shape) return document;
  const place = thruster.anchor ? { anchor: roundedPoint(point) } : { position: roundedPoint(toLocal(shape, point)) };
  return { ...document, thrusters: thrustersOf(document).with(index, { ...thruster, ...place }) };
}

/** Shapes about their common middle, rad; thrusters that are selected alone turn where they are.
 * @param {Level} document @param {readonly string[]} selection @param {number} angle @param {readonly Wall[]} walls @returns {Level} */
export function turned(document, selection, angle, walls) {
  const shapes = selectedShapes(document, selection).map((index) => document.shapes[index]);
  if (!shapes.length) {
    return selection.reduce((level, path) => {
      const found = parsePath(path);
      if (found?.part !== "thrusters" || !thrustersOf(level)[found.index]) return level;
      const thruster = thrustersOf(level)[found.index];
      return { ...level, thrusters: thrustersOf(level).with(found.index, { ...thruster, angle: rounded(wrapped(thruster.angle + angle)) }) };
    }, document);
  }
  const middle = shapes.length === 1 ? shapes[0].position : middleOf(shapes);
  const place = (/** @type {Point} */ point) => add(middle, rotate(sub(point, middle), angle));
  const carry = (/** @type {Shape} */ shape) => ({ ...shape, position: roundedPoint(place(shape.position)), angle: rounded(wrapped((shape.angle ?? 0) + angle)) });
  return carried(document, new Set(shapes.map((shape) => shape.id)), carry, place, walls);
}

/** Left and right exchanged, about the common middle. What turned one way turns the other.
 * @param {Level} document @param {readonly string[]} selection @param {readonly Wall[]} walls @returns {Level} */
export function mirrored(document, selection, walls) {
  const ids = idsOf(document, selection);
  if (!ids.size) return document;
  const [middle] = middleOf(document.shapes.filter((shape) => ids.has(shape.id)));
  const place = (/** @type {Point} */ [x, y]) => /** @type {Point} */ ([2 * middle - x, y]);
  const flipped = (/** @type {Point} */ [x, y]) => /** @type {Point} */ ([rounded(-x), y]);
  const negative = (/** @type {any} */ element, /** @type {string} */ field) => (element[field] === undefined ? {} : { [field]: rounded(-element[field]) });
  const carry = (/** @type {Shape} */ shape) => ({
    ...shape,
    position: roundedPoint(place(shape.position)),
    ...negative(shape, "angle"),
    ...(shape.vertices ? { vertices: shape.vertices.map(flipped).reverse() } : {}),
    ...(shape.velocity ? { velocity: flipped(shape.velocity) } : {}),
    ...negative(shape, "angular_velocity"),
  });
  const joint = (/** @type {any} */ entry) => ({
    ...entry,
    ...(entry.anchor_a ? { anchor_a: flipped(entry.anchor_a) } : {}),
    ...(entry.anchor_b ? { anchor_b: flipped(entry.anchor_b) } : {}),
    ...negative(entry, "rest_angle"),
    ...(entry.type === "prismatic" ? { axis: rounded(wrapped(Math.PI - (entry.axis ?? 0))) } : {}),
    ...(entry.limits && entry.type !== "prismatic" ? { limits: [rounded(-entry.limits[1]), rounded(-entry.limits[0])] } : {}),
    ...(entry.motor && entry.type !== "prismatic" ? { motor: { ...entry.motor, speed: rounded(-(entry.motor.speed ?? 1)) } } : {}),
  });
  const thruster = (/** @type {any} */ entry) => ({
    ...entry,
    ...(entry.position ? { position: flipped(entry.position) } : {}),
    angle: rounded(wrapped(Math.PI - entry.angle)),
  });
  return carried(document, ids, carry, place, walls, { joint, thruster });
}

/** Shapes moved so that their boxes share a side or a middle.
 * @param {Level} document @param {readonly string[]} selection @param {"left" | "right" | "top" | "bottom" | "middle" | "centre"} how
 * @param {readonly Wall[]} walls @returns {Level} */
export function aligned(document, selection, how, walls) {
  const indices = selectedShapes(document, selection);
  if (indices.length < 2) return document;
  const boxes = indices.map((index) => boundsOf(document.shapes[index]));
  const middle = middleOf(indices.map((index) => document.shapes[index]));
  return indices.reduce((level, index, k) => {
    const [left, bottom, right, top] = boxes[k];
    /** @type {Record<typeof how, Point>} */
    const step = {
      left: [Math.min(...boxes.map((box) => box[0])) - left, 0],
      right: [Math.max(...boxes.map((box) => box[2])) - right, 0],
      bottom: [0, Math.min(...boxes.map((box) => box[1])) - bottom],
      top: [0, Math.max(...boxes.map((box) => box[3])) - top],
      centre: [middle[0] - (left + right) / 2, 0],
      middle: [0, middle[1] - (bottom + top) / 2],
    };
    return moved(level, [`shapes[${index}]`], step[how], walls);
  }, document);
}

/** Shapes moved so that the gaps between their boxes are the same; the outermost stay.
 * @param {Level} document @param {readonly string[]} selection @param {0 | 1} axis along x or y @param {readonly Wall[]} walls @returns {Level} */
export function distributed(document, selection, axis, walls) {
  const boxes = selectedShapes(document, selection).map((index) => ({ index, box: boundsOf(document.shapes[index]) }));
  if (boxes.length < 3) return document;
  boxes.sort((a, b) => a.box[axis] + a.box[axis + 2] - b.box[axis] - b.box[axis + 2]);
  const extent = boxes[boxes.length - 1].box[axis + 2] - boxes[0].box[axis];
  const gap = (extent - boxes.reduce((sum, { box }) => sum + box[axis + 2] - box[axis], 0)) / (boxes.length - 1);
  let next = boxes[0].box[axis];
  return boxes.reduce((level, { index, box }) => {
    const step = /** @type {Point} */ ([0, 0]);
    step[axis] = next - box[axis];
    next += box[axis + 2] - box[axis] + gap;
    return moved(level, [`shapes[${index}]`], step, walls);
  }, document);
}

/** Without what is selected, and what was on its shapes. @param {Level} document @param {readonly string[]} selection @returns {Level} */
export function without(document, selection) {
  const ids = idsOf(document, selection);
  const isKept = (/** @type {string} */ part) => (/** @type {unknown} */ _, /** @type {number} */ index) => !selection.includes(`${part}[${index}]`);
  return {
    ...document,
    shapes: document.shapes.filter(isKept("shapes")),
    ...(document.joints ? { joints: document.joints.filter(isKept("joints")).filter((joint) => !ids.has(joint.a) && !ids.has(joint.b)) } : {}),
    ...(document.thrusters ? { thrusters: document.thrusters.filter(isKept("thrusters")).filter((thruster) => !ids.has(thruster.shape)) } : {}),
  };
}

/** Shapes that are selected, with the joints among them and their thrusters. @param {Level} document @param {readonly string[]} selection @returns {Copied} */
export function copied(document, selection) {
  const ids = idsOf(document, selection);
  return {
    format: COPIED_FORMAT,
    shapes: document.shapes.filter((shape) => ids.has(shape.id)),
    joints: jointsOf(document).filter((joint) => ids.has(joint.a) && ids.has(joint.b)),
    thrusters: thrustersOf(document).filter((thruster) => ids.has(thruster.shape)),
  };
}

/** Pastes a copy under new names, a step away; returns the document and its selection.
 * @param {Level} document @param {Copied} part @param {Point} step @param {readonly Wall[]} walls @returns {{ document: Level, selection: string[] }} */
export function pasted(document, part, step, walls) {
  /** @type {Map<string, string>} */
  const names = new Map();
  for (const shape of part.shapes) names.set(shape.id, newId(document, shape.id.replace(/_\d+$/, ""), new Set(names.values())));
  const named = (/** @type {string} */ id) => names.get(id) ?? id;
  let after = document;
  for (const shape of part.shapes) after = added(after, "shapes", { ...shape, id: named(shape.id) });
  for (const joint of part.joints) after = added(after, "joints", { ...joint, a: named(joint.a), b: named(joint.b) });
  for (const thruster of part.thrusters) after = added(after, "thrusters", { ...thruster, shape: named(thruster.shape) });
  const selection = part.shapes.map((_, k) => `shapes[${document.shapes.length + k}]`);
  return { document: moved(after, selection, step, walls), selection };
}

/** Everything that is joined to what is selected, directly or through others. @param {Level} document @param {readonly string[]} selection @returns {string[]} */
export function joined(document, selection) {
  const ids = idsOf(document, selection);
  const own = new Set(document.shapes.map((shape) => shape.id));
  for (let grew = true; grew; ) {
    grew = false;
    for (const { a, b } of jointsOf(document)) {
      if (ids.has(a) === ids.has(b) || !own.has(a) || !own.has(b)) continue;
      ids.add(a).add(b);
      grew = true;
    }
  }
  return document.shapes.flatMap((shape, index) => (ids.has(shape.id) ? [`shapes[${index}]`] : []));
}

/** Elements of the document with a role that only one may have, besides some, by their names.
 * @param {Level} document @param {string} role @param {readonly string[]} but paths */
export function rolesTaken(document, role, but) {
  return holdersOf(document, role, but).map((path) => elementAt(document, path).id ?? path.replace("walls.", ""));
}

/** Paths of those that hold green or blue, besides some. @param {Level} document @param {string} role @param {readonly string[]} but */
function holdersOf(document, role, but) {
  if (role !== "green" && role !== "blue") return [];
  const all = [...document.shapes.map((_, index) => `shapes[${index}]`), ...Object.keys(document.walls ?? {}).map((name) => `walls.${name}`)];
  return all.filter((path) => elementAt(document, path).role === role && !but.includes(path));
}

/** Shapes and walls with another role; one that was green or blue alone has none then.
 * @param {Level} document @param {readonly string[]} paths @param {string} role @returns {Level} */
export function withRole(document, paths, role) {
  const painted = (/** @type {Level} */ level, /** @type {string} */ path, /** @type {string} */ other) => {
    const { role: _, ...rest } = elementAt(level, path);
    return withElement(level, path, other === "none" ? rest : { ...rest, role: other });
  };
  const freed = holdersOf(document, role, paths).reduce((level, path) => painted(level, path, "none"), document);
  return paths.reduce((level, path) => painted(level, path, role), freed);
}

/** Another name for a shape, also where joints and thrusters use it. @param {Level} document @param {number} index @param {string} id @returns {Level} */
export function renamed(document, index, id) {
  const before = document.shapes[index].id;
  const named = (/** @type {string} */ name) => (name === before ? id : name);
  return {
    ...document,
    shapes: document.shapes.with(index, { ...document.shapes[index], id }),
    ...(document.joints ? { joints: document.joints.map((joint) => ({ ...joint, a: named(joint.a), b: named(joint.b) })) } : {}),
    ...(document.thrusters ? { thrusters: document.thrusters.map((thruster) => ({ ...thruster, shape: named(thruster.shape) })) } : {}),
  };
}

/** Paths of all elements, in the order of the document. @param {Level} document */
export function everything(document) {
  return PARTS.flatMap((part) => (document[part] ?? []).map((/** @type {unknown} */ _, /** @type {number} */ index) => `${part}[${index}]`));
}

/** Paths of a selection that still exist. @param {Level} document @param {readonly string[]} selection */
export const stillThere = (document, selection) => selection.filter((path) => elementAt(document, path) !== undefined);
