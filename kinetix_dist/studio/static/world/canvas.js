// Draws a world on a canvas from its display list (docs/play_protocol.md): the same primitives as jax2d/rasteriser.py.

/**
 * @typedef {[number, number]} Point
 * @typedef {object} Primitive
 * @property {"polygon" | "disc" | "line" | "rail" | "spring"} kind
 * @property {[string, number]} part
 * @property {number} body
 * @property {Point[]} points
 * @property {number[]} fill
 * @property {number[]} [outline]
 * @property {number} [radius]
 * @property {number} [width]
 * @property {Point} [upright]
 * @property {number} [thruster]
 * @property {Point} [scale_from]
 * @property {number} [size]
 * @property {number} [other]
 * @property {Point} [other_point]
 * @property {number} [angle]
 * @property {number} [reach]
 * @property {number} [coils]
 * @typedef {{ num_shapes: number, primitives: Primitive[] }} Display
 * @typedef {{ role_palette: number[][], background: number[], ink: number[], line_width: number, fixed_shade: number }} Palette
 * @typedef {{ context: CanvasRenderingContext2D, x: (value: number) => number, y: (value: number) => number, scale: number, dot: number }} Paper
 *   x, y: pixels of m; scale: pixels of a metre; dot: pixels of the canvas for one of the page
 */

export const VIEW = [-0.12, -0.12, 5.12, 5.12]; // lowest x, lowest y, highest x, highest y, m: the box and a rim of its walls
const ROLE_LETTERS = ["", "G", "B", "R"];
const HATCH_PX = 9; // between lines over what does not move
export const LETTER_FROM_M = 0.16; // smaller shapes have no letter

/**
 * The points of a primitive in the world, m; of rail and spring those of a line through all of them. null: a flame that
 * is not there. `poses` has x, y, angle of each shape from `start` on.
 * @param {Primitive} primitive
 * @param {ArrayLike<number>} poses
 * @param {number} start
 * @param {ArrayLike<number> | null} thrust
 * @returns {Point[] | null}
 */
export function worldPoints(primitive, poses, start, thrust) {
  const { body, points } = primitive;
  if (primitive.kind === "rail") return rail(primitive, poses, start);
  if (primitive.kind === "spring") return coils(primitive, poses, start);
  if (primitive.upright) {
    const [x, y] = placed(primitive.upright, body, poses, start);
    return points.map(([dx, dy]) => [x + dx, y + dy]);
  }
  if (primitive.thruster !== undefined && primitive.scale_from && primitive.size !== undefined) {
    const fire = thrust ? thrust[primitive.thruster] : 0;
    if (!(fire > 0)) return null;
    const [bx, by] = primitive.scale_from;
    const scale = primitive.size * fire;
    return points.map(([x, y]) => placed([bx + (x - bx) * scale, by + (y - by) * scale], body, poses, start));
  }
  return points.map((point) => placed(point, body, poses, start));
}

/** @param {Point} point @param {number} body @param {ArrayLike<number>} poses @param {number} start @returns {Point} */
function placed([x, y], body, poses, start) {
  const at = start + 3 * body;
  const cos = Math.cos(poses[at + 2]);
  const sin = Math.sin(poses[at + 2]);
  return [poses[at] + cos * x - sin * y, poses[at + 1] + sin * x + cos * y];
}

/** @param {Primitive} p @param {ArrayLike<number>} poses @param {number} start @returns {Point[]} */
function rail(p, poses, start) {
  const from = placed(p.points[0], p.body, poses, start);
  const turn = poses[start + 3 * p.body + 2] + (p.angle ?? 0);
  const axis = [Math.cos(turn), Math.sin(turn)];
  const at = placed(/** @type {Point} */ (p.other_point), p.other ?? 0, poses, start);
  const along = (at[0] - from[0]) * axis[0] + (at[1] - from[1]) * axis[1];
  const reach = p.reach ?? 0;
  return [along - reach, along + reach].map((share) => [from[0] + share * axis[0], from[1] + share * axis[1]]);
}

/** @param {Primitive} p @param {ArrayLike<number>} poses @param {number} start @returns {Point[]} */
function coils(p, poses, start) {
  const a = placed(p.points[0], p.body, poses, start);
  const b = placed(/** @type {Point} */ (p.other_point), p.other ?? 0, poses, start);
  const count = p.coils ?? 0;
  if (!count) return [a, b];
  const along = [b[0] - a[0], b[1] - a[1]];
  const length = Math.hypot(along[0], along[1]);
  if (length === 0) return [a, b];
  const reach = p.reach ?? 0;
  /** @type {Point[]} */
  const line = [a];
  for (let k = 0; k <= 2 * count; k++) {
    const share = 0.1 + (0.8 * k) / (2 * count);
    const side = k === 0 || k === 2 * count ? 0 : k % 2 ? -reach : reach;
    line.push([a[0] + share * along[0] - (side * along[1]) / length, a[1] + share * along[1] + (side * along[0]) / length]);
  }
  return [...line, b];
}

/** Mapping of the world to a canvas. @param {HTMLCanvasElement} canvas @param {number[]} view what is seen, m @returns {Paper} */
export function paperOf(canvas, view) {
  const scale = Math.min(canvas.width / (view[2] - view[0]), canvas.height / (view[3] - view[1]));
  return {
    context: /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d")),
    x: (value) => (value - view[0]) * scale,
    y: (value) => (view[3] - value) * scale,
    scale,
    dot: devicePixelRatio || 1,
  };
}

/**
 * Fills the canvas with one picture.
 * @param {HTMLCanvasElement} canvas its size in pixels stays
 * @param {Display} display
 * @param {ArrayLike<number>} poses
 * @param {Palette} palette
 * @param {{ start?: number, thrust?: ArrayLike<number> | null, letters?: boolean, view?: number[] }} [options]
 */
export function drawWorld(canvas, display, poses, palette, { start = 0, thrust = null, letters = false, view = VIEW } = {}) {
  const { context, x, y, scale } = paperOf(canvas, view);
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.fillStyle = rgb(palette.background);
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.lineJoin = "miter";
  context.lineCap = "round";
  for (const primitive of display.primitives) {
    const points = worldPoints(primitive, poses, start, thrust);
    if (!points || !points.every((point) => Number.isFinite(point[0]) && Number.isFinite(point[1]))) continue;
    trace(context, primitive, points, x, y, scale);
    if (primitive.kind === "disc" || primitive.kind === "polygon") {
      context.fillStyle = rgb(primitive.fill);
      context.fill();
      if (letters && isFixed(primitive, palette)) hatched(context, points.map((point) => /** @type {Point} */ ([x(point[0]), y(point[1])])), (primitive.radius ?? 0) * scale, primitive.outline ?? []);
      if (primitive.outline) {
        trace(context, primitive, points, x, y, scale);
        outlined(context, primitive.outline, palette.line_width);
      }
    } else {
      context.strokeStyle = rgb(primitive.fill);
      context.lineWidth = primitive.width ?? palette.line_width;
      context.stroke();
    }
  }
  if (letters) drawLetters(context, display, poses, start, palette, x, y, scale);
}

/** The path of a primitive, of discs and polygons closed. @param {CanvasRenderingContext2D} context @param {Primitive} primitive
 * @param {Point[]} points @param {(v: number) => number} x @param {(v: number) => number} y @param {number} scale */
function trace(context, primitive, points, x, y, scale) {
  context.beginPath();
  if (primitive.kind === "disc") context.arc(x(points[0][0]), y(points[0][1]), (primitive.radius ?? 0) * scale, 0, 2 * Math.PI);
  else points.forEach((point, k) => (k ? context.lineTo(x(point[0]), y(point[1])) : context.moveTo(x(point[0]), y(point[1]))));
  if (primitive.kind === "disc" || primitive.kind === "polygon") context.closePath();
}

/** True for a shape that is drawn in the shade of fixed ones. @param {Primitive} primitive @param {Palette} palette */
function isFixed({ part, fill, outline }, palette) {
  const full = palette.role_palette[roleOf(fill, palette)];
  return part[0] === "shape" && outline !== undefined && fill.every((value, k) => Math.abs(value - full[k] * palette.fixed_shade) <= 1);
}

/** Lines from lower left to upper right over the path of the canvas: fixed shapes are marked by more than their shade.
 * @param {CanvasRenderingContext2D} context @param {Point[]} points pixels @param {number} reach pixels beyond them @param {number[]} colour */
function hatched(context, points, reach, colour) {
  const [left, right] = [Math.min, Math.max].map((end, k) => end(...points.map((point) => point[0])) + (k ? reach : -reach));
  const [top, bottom] = [Math.min, Math.max].map((end, k) => end(...points.map((point) => point[1])) + (k ? reach : -reach));
  if (right - left < HATCH_PX || bottom - top < HATCH_PX) return;
  const every = HATCH_PX * (devicePixelRatio || 1);
  context.save();
  context.clip();
  context.beginPath();
  for (let start = Math.floor((left - (bottom - top)) / every) * every; start < right; start += every) {
    context.moveTo(start, bottom);
    context.lineTo(start + bottom - top, top);
  }
  context.strokeStyle = rgb(colour);
  context.lineWidth = devicePixelRatio || 1;
  context.stroke();
  context.restore();
}

/** The outline lies inside of the edge. @param {CanvasRenderingContext2D} context @param {number[]} colour @param {number} width */
function outlined(context, colour, width) {
  context.save();
  context.clip();
  context.strokeStyle = rgb(colour);
  context.lineWidth = 2 * width;
  context.stroke();
  context.restore();
}

/** Roles have letters too: G touches B, not R.
 * @param {CanvasRenderingContext2D} context @param {Display} display @param {ArrayLike<number>} poses @param {number} start
 * @param {Palette} palette @param {(v: number) => number} x @param {(v: number) => number} y @param {number} scale */
function drawLetters(context, display, poses, start, palette, x, y, scale) {
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillStyle = "#ffffff";
  for (const primitive of display.primitives) {
    if (primitive.part[0] !== "shape" || !primitive.outline) continue;
    const letter = ROLE_LETTERS[roleOf(primitive.fill, palette)];
    const reach = primitive.kind === "disc" ? (primitive.radius ?? 0) : Math.min(...primitive.points.map(([px, py]) => Math.hypot(px, py)));
    if (!letter || reach < LETTER_FROM_M) continue;
    const at = start + 3 * primitive.body;
    context.font = `600 ${Math.max(9, Math.min(0.22, reach) * scale)}px sans-serif`;
    context.fillText(letter, x(poses[at]), y(poses[at + 1]));
  }
}

/** The role whose colour, or a darker shade of it, this is. @param {number[]} fill @param {Palette} palette */
export function roleOf(fill, palette) {
  let best = 0;
  let least = Infinity;
  palette.role_palette.forEach((colour, role) => {
    const shade = fill.reduce((sum, value, k) => sum + value * colour[k], 0) / colour.reduce((sum, value) => sum + value * value, 0);
    const distance = Math.hypot(...fill.map((value, k) => value - shade * colour[k]));
    if (distance < least) [best, least] = [role, distance];
  });
  return best;
}

/** @param {number[]} colour */
function rgb(colour) {
  return `rgb(${colour.map((value) => Math.round(value)).join(",")})`;
}
