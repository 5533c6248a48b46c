// A level document (docs/level_format.md) as a value: functions return another document and never change one.
// Elements (shapes, joints, thrusters, walls) are named as the validator names them: "shapes[2]", "joints[0]", "thrusters[1]", "walls.floor".
import { add, bounds, distance, distanceToPolygon, rotate, roundedPoint, sub } from "./geometry.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {{ id: string, type: string, position: Point, angle?: number, [field: string]: any }} Shape
 * @typedef {{ type: string, a: string, b: string, anchor?: Point, anchor_a?: Point, anchor_b?: Point, [field: string]: any }} Joint
 * @typedef {{ shape: string, anchor?: Point, position?: Point, angle: number, [field: string]: any }} Thruster
 * @typedef {{ format: string, version: number, name: string, size: string, shapes: Shape[], joints?: Joint[],
 *   thrusters?: Thruster[], walls?: Record<string, any>, [field: string]: any }} Level
 * @typedef {{ name: string, position: Point, half_extents: Point }} Wall
 * @typedef {"shapes" | "joints" | "thrusters"} Part
 */

/** @type {readonly Part[]} */
export const PARTS = ["shapes", "joints", "thrusters"];
export const FORMAT = "kinetix-dist-level";
export const WORLD_M = 5; // width and height of the box

/** @returns {Level} */
export function newLevel() {
  return { format: FORMAT, version: 1, name: "new level", size: "m", shapes: [], joints: [], thrusters: [] };
}

/** The file of a document: one line for each shape, joint and thruster, as kinetix_dist/level/document.py writes it.
 * @param {Record<string, any>} document */
export function documentText(document) {
  const lines = Object.entries(document).map(([key, value]) => {
    const isRows = Array.isArray(value) && value.length > 0 && typeof value[0] === "object" && !Array.isArray(value[0]);
    const text = isRows ? `[\n${value.map((row) => `    ${spaced(row)}`).join(",\n")}\n  ]` : spaced(value);
    return `  ${JSON.stringify(key)}: ${text}`;
  });
  return `{\n${lines.join(",\n")}\n}\n`;
}

/** @param {any} value @returns {string} */
function spaced(value) {
  if (Array.isArray(value)) return `[${value.map(spaced).join(", ")}]`;
  if (value && typeof value === "object") {
    return `{${Object.entries(value).map(([key, inner]) => `${JSON.stringify(key)}: ${spaced(inner)}`).join(", ")}}`;
  }
  return JSON.stringify(value);
}

/** @param {string} path @returns {{ part: Part, index: number } | { part: "walls", name: string } | null} */
export function parsePath(path) {
  const item = /^(shapes|joints|thrusters)\[(\d+)\]/.exec(path);
  if (item) return { part: /** @type {Part} */ (item[1]), index: Number(item[2]) };
  const wall = /^walls\.(\w+)/.exec(path);
  return wall ? { part: "walls", name: wall[1] } : null;
}

/** The element of a path, or of a path into it; undefined: it is not there. A wall without fields is {}.
 * @param {Level} document @param {string} path @returns {any} */
export function elementAt(document, path) {
  const found = parsePath(path);
  if (!found) return undefined;
  return found.part === "walls" ? (document.walls?.[found.name] ?? {}) : document[found.part]?.[found.index];
}

/** @param {Level} document @param {string} path @param {any} element @returns {Level} */
export function withElement(document, path, element) {
  const found = parsePath(path);
  if (!found) throw new Error(`${path} names nothing`);
  if (found.part === "walls") {
    const walls = { ...document.walls, [found.name]: element };
    if (!Object.keys(element).length) delete walls[found.name];
    if (Object.keys(walls).length) return { ...document, walls };
    const { walls: _, ...rest } = document;
    return /** @type {Level} */ (rest);
  }
  const list = [.../** @type {any[]} */ (document[found.part] ?? [])];
  list[found.index] = element;
  return { ...document, [found.part]: list };
}

/** Document with one more element at the end of a part. @param {Level} document @param {Part} part @param {any} element @returns {Level} */
export function added(document, part, element) {
  return { ...document, [part]: [...(document[part] ?? []), element] };
}

/** @param {Level} document */
export const shapesOf = (document) => (Array.isArray(document.shapes) ? document.shapes : []).filter(isDrawable);
/** @param {Level} document @returns {Joint[]} */
export const jointsOf = (document) => document.joints ?? [];
/** @param {Level} document @returns {Thruster[]} */
export const thrustersOf = (document) => document.thrusters ?? [];

/** True where a shape has enough fields to be drawn. @param {any} shape */
export function isDrawable(shape) {
  const numbers = (/** @type {any} */ list) => Array.isArray(list) && list.length === 2 && list.every(Number.isFinite);
  if (!shape || typeof shape !== "object" || typeof shape.id !== "string" || !numbers(shape.position) || !Number.isFinite(shape.angle ?? 0)) return false;
  if (shape.type === "circle") return shape.radius > 0;
  if (shape.type === "box") return shape.width > 0 && shape.height > 0;
  return shape.type === "polygon" && Array.isArray(shape.vertices) && shape.vertices.length > 2 && shape.vertices.every(numbers);
}

/** Corners in the shape's own frame, counter-clockwise; of a circle none. @param {Shape} shape @returns {Point[]} */
export function cornersOf(shape) {
  if (shape.type === "circle") return [];
  if (shape.type === "polygon") return shape.vertices;
  const x = shape.width / 2;
  const y = shape.height / 2;
  return [[x, y], [-x, y], [-x, -y], [x, -y]];
}

/** @param {{ position: Point, angle?: number }} shape @param {Point} point @returns {Point} */
export const toWorld = (shape, point) => add(shape.position, rotate(point, shape.angle ?? 0));
/** @param {{ position: Point, angle?: number }} shape @param {Point} point @returns {Point} */
export const toLocal = (shape, point) => rotate(sub(point, shape.position), -(shape.angle ?? 0));

/** @param {Shape} shape */
export const worldCorners = (shape) => cornersOf(shape).map((corner) => toWorld(shape, corner));

/** Lowest and highest x and y. @param {Shape} shape @returns {[number, number, number, number]} */
export function boundsOf(shape) {
  if (shape.type !== "circle") return bounds(worldCorners(shape));
  const [x, y] = shape.position;
  return [x - shape.radius, y - shape.radius, x + shape.radius, y + shape.radius];
}

/** How far a point is from a shape, m; 0 within. @param {Shape} shape @param {Point} point */
export function distanceTo(shape, point) {
  return shape.type === "circle" ? Math.max(0, distance(point, shape.position) - shape.radius) : distanceToPolygon(point, worldCorners(shape));
}

/** Corners of a wall, counter-clockwise. @param {Wall} wall @returns {Point[]} */
export function wallCorners({ position: [x, y], half_extents: [w, h] }) {
  return [[x + w, y + h], [x - w, y + h], [x - w, y - h], [x + w, y - h]];
}

/** The shape or wall of an id, as something with a position and an angle. @param {Level} document @param {string} id
 * @param {readonly Wall[]} walls @returns {{ position: Point, angle?: number } | undefined} */
export function bodyOf(document, id, walls) {
  return shapesOf(document).find((shape) => shape.id === id) ?? walls.find((wall) => wall.name === id);
}

/** World positions of both ends of a joint; null where a shape is missing.
 * @param {Level} document @param {Joint} joint @param {readonly Wall[]} walls @returns {[Point, Point] | null} */
export function jointEnds(document, joint, walls) {
  const a = bodyOf(document, joint.a, walls);
  const b = bodyOf(document, joint.b, walls);
  if (!a || !b) return null;
  if (joint.anchor) return [joint.anchor, joint.anchor];
  return [toWorld(a, joint.anchor_a ?? [0, 0]), toWorld(b, joint.anchor_b ?? [0, 0])];
}

/** Point in the world where a thruster pushes, and its direction, rad. @param {Level} document @param {Thruster} thruster */
export function thrusterPlace(document, thruster) {
  const shape = shapesOf(document).find((entry) => entry.id === thruster.shape);
  if (!shape) return null;
  return { at: thruster.anchor ?? toWorld(shape, thruster.position ?? [0, 0]), angle: thruster.angle + (shape.angle ?? 0), shape };
}

/** A name that no shape has: box_1, box_2, ... @param {Level} document @param {string} kind @param {Set<string>} [taken] */
export function newId(document, kind, taken = new Set()) {
  const names = new Set([...document.shapes.map((shape) => shape.id), ...taken]);
  let number = 1;
  while (names.has(`${kind}_${number}`)) number++;
  return `${kind}_${number}`;
}

/**
 * The document with another shape in the place of one, whose joints and thrusters stay where they are in the world.
 * @param {Level} document @param {number} index @param {Shape} shape @param {readonly Wall[]} walls @returns {Level}
 */
export function reshaped(document, index, shape, walls) {
  const before = document.shapes[index];
  const held = (/** @type {Point} */ point) => roundedPoint(toLocal(shape, toWorld(before, point)));
  const joints = document.joints?.map((joint) => ({
    ...joint,
    ...(joint.anchor_a && joint.a === before.id ? { anchor_a: held(joint.anchor_a) } : {}),
    ...(joint.anchor_b && joint.b === before.id ? { anchor_b: held(joint.anchor_b) } : {}),
  }));
  const thrusters = document.thrusters?.map((thruster) =>
    thruster.shape === before.id && !thruster.anchor && thruster.position ? { ...thruster, position: held(thruster.position) } : thruster,
  );
  const shapes = document.shapes.with(index, shape);
  return { ...document, shapes, ...(joints ? { joints } : {}), ...(thrusters ? { thrusters } : {}) };
}
