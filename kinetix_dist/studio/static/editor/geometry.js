// Points and polygons in the plane. Points are [x, y] in m, angles in rad, counter-clockwise.

/** @typedef {[number, number]} Point */

/** @param {Point} a @param {Point} b @returns {Point} */
export const add = (a, b) => [a[0] + b[0], a[1] + b[1]];
/** @param {Point} a @param {Point} b @returns {Point} */
export const sub = (a, b) => [a[0] - b[0], a[1] - b[1]];
/** @param {Point} a @param {Point} b */
export const distance = (a, b) => Math.hypot(a[0] - b[0], a[1] - b[1]);
/** @param {Point} a @param {Point} b */
export const cross = (a, b) => a[0] * b[1] - a[1] * b[0];

/** @param {Point} point @param {number} angle @returns {Point} */
export function rotate([x, y], angle) {
  const cos = Math.cos(angle);
  const sin = Math.sin(angle);
  return [cos * x - sin * y, sin * x + cos * y];
}

/** The same direction as an angle in (-pi, pi]. @param {number} angle */
export function wrapped(angle) {
  const turns = angle - 2 * Math.PI * Math.round(angle / (2 * Math.PI));
  return turns <= -Math.PI ? turns + 2 * Math.PI : turns;
}

/** Positive for corners that run counter-clockwise, m^2. @param {Point[]} corners */
export function signedArea(corners) {
  return corners.reduce((sum, here, k) => sum + 0.5 * cross(here, corners[(k + 1) % corners.length]), 0);
}

/** Centroid of the area; without an area the first corner. As jax2d/shapes.py: polygon_integrals. @param {Point[]} corners @returns {Point} */
export function centroid(corners) {
  const [first] = corners;
  const local = corners.map((corner) => sub(corner, first));
  let area = 0;
  let x = 0;
  let y = 0;
  local.forEach((here, k) => {
    const next = local[(k + 1) % local.length];
    const turn = cross(here, next);
    area += 0.5 * turn;
    x += turn * (here[0] + next[0]);
    y += turn * (here[1] + next[1]);
  });
  return area === 0 ? first : [first[0] + x / (6 * area), first[1] + y / (6 * area)];
}

/** True where a point lies in a convex polygon whose corners run counter-clockwise. @param {Point} point @param {Point[]} corners */
export function isInside(point, corners) {
  return corners.every((here, k) => cross(sub(corners[(k + 1) % corners.length], here), sub(point, here)) >= 0);
}

/** How far a point is from a convex polygon whose corners run counter-clockwise, m; 0 within. @param {Point} point @param {Point[]} corners */
export function distanceToPolygon(point, corners) {
  if (isInside(point, corners)) return 0;
  return Math.min(...corners.map((here, k) => distanceToSegment(point, here, corners[(k + 1) % corners.length])));
}

/** @param {Point} point @param {Point} start @param {Point} end */
function distanceToSegment(point, start, end) {
  const along = sub(end, start);
  const squared = along[0] ** 2 + along[1] ** 2;
  const offset = sub(point, start);
  const share = squared ? Math.min(Math.max((offset[0] * along[0] + offset[1] * along[1]) / squared, 0), 1) : 0;
  return distance(point, [start[0] + share * along[0], start[1] + share * along[1]]);
}

/** Corners of the convex hull, counter-clockwise (Andrew's monotone chain). @param {Point[]} points @returns {Point[]} */
export function hull(points) {
  const sorted = [...points].sort((a, b) => a[0] - b[0] || a[1] - b[1]);
  const half = (/** @type {Point[]} */ line) => {
    /** @type {Point[]} */
    const hull = [];
    for (const point of line) {
      while (hull.length > 1 && cross(sub(hull[hull.length - 1], hull[hull.length - 2]), sub(point, hull[hull.length - 1])) <= 1e-9) hull.pop();
      hull.push(point);
    }
    hull.pop();
    return hull;
  };
  return [...half(sorted), ...half(sorted.reverse())];
}

/** Lowest and highest x and y. @param {Point[]} points @returns {[number, number, number, number]} */
export function bounds(points) {
  const x = points.map((point) => point[0]);
  const y = points.map((point) => point[1]);
  return [Math.min(...x), Math.min(...y), Math.max(...x), Math.max(...y)];
}

/** To a tenth of a micrometre: what is written into files. @param {number} value */
export function rounded(value) {
  const result = Math.round(value * 1e7) / 1e7;
  return result === 0 ? 0 : result;
}

/** @param {Point} point @returns {Point} */
export const roundedPoint = (point) => [rounded(point[0]), rounded(point[1])];
