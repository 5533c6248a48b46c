// Snapping of a pointer: to a corner, a centre, an anchor, in line with one, or on the grid. What is nearest to the pointer wins.
import { distanceTo, jointEnds, jointsOf, shapesOf, wallCorners, WORLD_M, worldCorners } from "./document.js";
import { distance, distanceToPolygon, rounded } from "./geometry.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {{ at: Point, gap: number }} Target gap: from the pointer to the shape, wall or joint that has the point, m
 */

export const GRID_M = 0.1;
export const TURN_RAD = Math.PI / 12; // 15 degrees
const POINT_PX = 9; // how near a pointer has to come to a point
const LINE_PX = 5; // to a line through one: there are many, and half of the grid has to stay in reach

/** Points that a pointer is drawn to: centres, corners, middles of edges, anchors; of all shapes but some, and of walls.
 * @param {import("./document.js").Level} document @param {readonly import("./document.js").Wall[]} walls @param {Point} pointer
 * @param {ReadonlySet<string>} [but] @returns {Target[]} */
export function snapTargets(document, walls, pointer, but = new Set()) {
  const shapes = shapesOf(document).filter((shape) => !but.has(shape.id)).flatMap((shape) => {
    const gap = distanceTo(shape, pointer);
    return [shape.position, ...outline(worldCorners(shape))].map((at) => ({ at, gap }));
  });
  const sides = walls.flatMap((wall) => {
    const gap = distanceToPolygon(pointer, wallCorners(wall));
    return outline(wallCorners(wall)).map(inMicrometres).filter(isInBox).map((at) => ({ at, gap }));
  });
  const joints = jointsOf(document).flatMap((joint) => {
    const ends = but.has(joint.a) || but.has(joint.b) ? null : jointEnds(document, joint, walls);
    return ends ? [{ at: ends[0], gap: distance(ends[0], pointer) }] : [];
  });
  return [...shapes, ...sides, ...joints];
}

/** Corners, and middles of edges. @param {Point[]} corners @returns {Point[]} */
function outline(corners) {
  const middles = corners.map((here, k) => {
    const next = corners[(k + 1) % corners.length];
    return /** @type {Point} */ ([(here[0] + next[0]) / 2, (here[1] + next[1]) / 2]);
  });
  return [...corners, ...middles];
}

/** Walls come from arrays of float32, in which the floor is 0.4 m high to 4e-7 m. @param {Point} point */
const inMicrometres = (point) => /** @type {Point} */ (point.map((value) => Math.round(value * 1e6) / 1e6));

/** @param {Point} point */
const isInBox = (point) => point.every((value) => value >= 0 && value <= WORLD_M);

/**
 * A point near a target becomes the nearest target. Else each of x and y becomes that of a target it is in line with: of the
 * shape, wall or joint that is nearest to the pointer, as the floor below it; else that of the grid.
 * @param {Point} point @param {Target[]} targets @param {number} px m of a pixel
 * @returns {{ point: Point, guides: { axis: 0 | 1, at: number }[] }} guides: lines that it was drawn to
 */
export function snapped(point, targets, px) {
  const near = least(targets, (target) => distance(point, target.at));
  if (near && distance(point, near.at) <= POINT_PX * px) return { point: near.at, guides: [] };
  /** @type {{ axis: 0 | 1, at: number }[]} */
  const guides = [];
  const placed = /** @type {const} */ ([0, 1]).map((axis) => {
    const off = (/** @type {Target} */ target) => Math.abs(target.at[axis] - point[axis]);
    const inLine = targets.filter((target) => off(target) <= LINE_PX * px);
    const owner = least(inLine, (target) => target.gap);
    const line = owner && least(inLine.filter((target) => target.gap === owner.gap), off);
    const onGrid = rounded(Math.round(point[axis] / GRID_M) * GRID_M);
    if (!line || Math.abs(line.at[axis] - onGrid) <= 1e-9) return onGrid;
    guides.push({ axis, at: line.at[axis] });
    return line.at[axis];
  });
  return { point: /** @type {Point} */ (placed), guides };
}

/** @param {Target[]} targets @param {(target: Target) => number} measure @returns {Target | null} */
function least(targets, measure) {
  return targets.reduce((/** @type {Target | null} */ best, target) => (best === null || measure(target) < measure(best) ? target : best), null);
}

/** @param {number} angle */
export const snappedAngle = (angle) => rounded(Math.round(angle / TURN_RAD) * TURN_RAD);
