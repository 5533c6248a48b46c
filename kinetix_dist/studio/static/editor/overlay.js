// Overlay of the editor on the world: selection, handles, limits, guides, sketches. They differ by shape, not by colour alone.
import { LETTER_FROM_M } from "../world/canvas.js";
import { boundsOf, jointEnds, jointsOf, parsePath, shapesOf, thrusterPlace, thrustersOf, worldCorners } from "./document.js";
import { distance } from "./geometry.js";
import { handlesOf } from "./handles.js";
import { landingWords } from "./joining.js";
import { ARC_M, axisReach, jointFacts, sliderFacts } from "./joint_handles.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("../world/canvas.js").Paper} Paper
 */

const HANDLE_PX = 6;
const LETTERS = { green: "G", blue: "B", red: "R" };

/** @param {Paper} paper @param {import("./state.js").Editor} editor */
export function drawOverlay(paper, editor) {
  const { context, dot } = paper;
  const accent = "#0b62b8";
  context.lineWidth = 1.5 * dot;
  smallRoles(paper, editor.document);
  for (const path of editor.selection) outlineOf(paper, editor, path, accent);
  for (const path of editor.selection) limitsOf(paper, editor, path, accent);
  for (const handle of handlesOf(editor.document, editor.selection, editor.walls, dot / paper.scale)) {
    if (handle.kind === "turn" && handle.middle) line(paper, [handle.middle, handle.at], accent, [3, 3]);
    const [x, y] = [paper.x(handle.at[0]), paper.y(handle.at[1])];
    context.beginPath();
    if (["turn", "direction", "rest", "axis"].includes(handle.kind)) context.arc(x, y, HANDLE_PX * dot, 0, 2 * Math.PI);
    else context.rect(x - (HANDLE_PX - 1) * dot, y - (HANDLE_PX - 1) * dot, 2 * (HANDLE_PX - 1) * dot, 2 * (HANDLE_PX - 1) * dot);
    context.fillStyle = "#ffffff";
    context.fill();
    context.strokeStyle = accent;
    context.stroke();
  }
  for (const { axis, at } of editor.guides) line(paper, axis ? [[-99, at], [99, at]] : [[at, -99], [at, 99]], "#d55e00", [4, 4]);
  if (editor.hover) landing(paper, editor, editor.hover);
  sketchOf(paper, editor.sketch, accent);
  if (editor.cursor) cross(paper, editor.cursor);
}

/** Roles of shapes that are too small for a letter, next to them. @param {Paper} paper @param {import("./document.js").Level} document */
function smallRoles({ context, x, y, dot }, document) {
  context.font = `600 ${11 * dot}px sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "bottom";
  context.fillStyle = "#343640";
  for (const shape of shapesOf(document)) {
    const letter = LETTERS[/** @type {keyof typeof LETTERS} */ (shape.role)];
    const [left, bottom, right, top] = boundsOf(shape);
    const reach = shape.type === "circle" ? shape.radius : Math.min(...worldCorners(shape).map((corner) => distance(corner, [(left + right) / 2, (bottom + top) / 2])));
    if (letter && reach < LETTER_FROM_M) context.fillText(letter, x((left + right) / 2), y(top) - 2 * dot);
  }
}

/** @param {Paper} paper @param {import("./state.js").Editor} editor @param {string} path @param {string} accent */
function outlineOf(paper, editor, path, accent) {
  const { context, x, y, scale, dot } = paper;
  const found = parsePath(path);
  if (!found) return;
  context.beginPath();
  if (found.part === "walls") {
    const wall = editor.walls.find((entry) => entry.name === found.name);
    if (!wall) return;
    const [[px, py], [hx, hy]] = [wall.position, wall.half_extents];
    context.rect(x(px - hx), y(py + hy), 2 * hx * scale, 2 * hy * scale);
  } else if (found.part === "shapes") {
    const shape = editor.document.shapes[found.index];
    if (!shapesOf(editor.document).includes(shape)) return;
    if (shape.type === "circle") context.arc(x(shape.position[0]), y(shape.position[1]), shape.radius * scale, 0, 2 * Math.PI);
    else {
      for (const corner of worldCorners(shape)) context.lineTo(x(corner[0]), y(corner[1]));
      context.closePath();
    }
  } else if (found.part === "joints") {
    for (const end of jointEnds(editor.document, jointsOf(editor.document)[found.index], editor.walls) ?? []) ring(paper, end);
  } else {
    const place = thrusterPlace(editor.document, thrustersOf(editor.document)[found.index]);
    if (!place) return;
    ring(paper, place.at);
    line(paper, [place.at, [place.at[0] + 0.45 * Math.cos(place.angle), place.at[1] + 0.45 * Math.sin(place.angle)]], accent, []);
    return;
  }
  // White below blue: seen on any colour.
  context.setLineDash([]);
  context.strokeStyle = "#ffffff";
  context.lineWidth = 4 * dot;
  context.stroke();
  context.strokeStyle = accent;
  context.lineWidth = 2 * dot;
  context.stroke();
}

/** @param {Paper} paper @param {Point} at */
function ring({ context, x, y, dot }, at) {
  context.moveTo(x(at[0]) + 11 * dot, y(at[1]));
  context.arc(x(at[0]), y(at[1]), 11 * dot, 0, 2 * Math.PI);
}

/** The range of a joint with a mark where it is: of a revolute joint an arc about it, of a slider a line along its axis. @param {Paper} paper @param {import("./state.js").Editor} editor @param {string} path @param {string} accent */
function limitsOf(paper, editor, path, accent) {
  const found = parsePath(path);
  const joint = found?.part === "joints" ? jointsOf(editor.document)[found.index] : null;
  if (joint?.type === "prismatic") return sliderOf(paper, editor, joint, accent);
  const facts = joint && jointFacts(editor.document, joint, editor.walls);
  if (!facts) return;
  const atRest = facts.towards - facts.coordinate;
  line(paper, [facts.at, [facts.at[0] + ARC_M * Math.cos(atRest), facts.at[1] + ARC_M * Math.sin(atRest)]], "#d55e00", [2, 3]);
  if (!joint.limits || joint.type !== "revolute") return;
  const { context, x, y, scale } = paper;
  const [low, high] = joint.limits.map((/** @type {number} */ limit) => facts.towards + limit - facts.coordinate);
  context.beginPath();
  context.moveTo(x(facts.at[0]), y(facts.at[1]));
  context.arc(x(facts.at[0]), y(facts.at[1]), ARC_M * scale, -low, -high, true); // pixels run down
  context.closePath();
  context.fillStyle = "rgba(11, 98, 184, 0.18)";
  context.fill();
  context.strokeStyle = accent;
  context.stroke();
  line(paper, [facts.at, [facts.at[0] + ARC_M * Math.cos(facts.towards), facts.at[1] + ARC_M * Math.sin(facts.towards)]], accent, [3, 2]);
}

/** @param {Paper} paper @param {import("./state.js").Editor} editor @param {any} joint @param {string} accent */
function sliderOf(paper, editor, joint, accent) {
  const facts = sliderFacts(editor.document, joint, editor.walls);
  if (!facts) return;
  line(paper, [facts.at, facts.place(axisReach(joint))], "#d55e00", [2, 3]);
  if (!joint.limits) return;
  line(paper, joint.limits.map(facts.place), accent, []);
  for (const limit of joint.limits) {
    const [x, y] = facts.place(limit);
    const across = /** @type {Point} */ ([-0.1 * Math.sin(facts.angle), 0.1 * Math.cos(facts.angle)]);
    line(paper, [[x - across[0], y - across[1]], [x + across[0], y + across[1]]], accent, []);
  }
}

/** @param {Paper} paper @param {Point[]} points @param {string} stroke @param {number[]} dash */
function line({ context, x, y, dot }, points, stroke, dash) {
  context.save();
  context.beginPath();
  points.forEach((point, k) => (k ? context.lineTo(x(point[0]), y(point[1])) : context.moveTo(x(point[0]), y(point[1]))));
  context.setLineDash(dash.map((length) => length * dot));
  context.strokeStyle = stroke;
  context.lineWidth = 1.5 * dot;
  context.stroke();
  context.restore();
}

/** @param {Paper} paper @param {import("./state.js").Sketch | null} sketch @param {string} accent */
function sketchOf(paper, sketch, accent) {
  if (!sketch) return;
  if (sketch.kind === "rectangle") {
    const { from, to } = sketch;
    line(paper, [from, [to[0], from[1]], to, [from[0], to[1]], from], accent, [5, 4]);
  } else if (sketch.kind === "line") line(paper, [sketch.from, sketch.to], accent, [5, 4]);
  else {
    const points = sketch.to ? [...sketch.points, sketch.to] : sketch.points;
    line(paper, points, accent, []);
    for (const point of points) cross(paper, point);
  }
}

/** Where a joint would land: the two shapes that it would hold, and its anchor; else why there would be none.
 * @param {Paper} paper @param {import("./state.js").Editor} editor @param {import("./joining.js").Landing} hover */
function landing(paper, editor, hover) {
  const { context, x, y, dot } = paper;
  const colour = hover.why ? "#8a4b00" : "#0b62b8";
  if (!hover.joint) for (const path of hover.bodies) outlineOf(paper, editor, path, hover.why ? "#b8843a" : "#d55e00");
  if (hover.joint) outlineOf(paper, editor, hover.joint, colour);
  const [left, top] = [x(hover.at[0]), y(hover.at[1])];
  if (!hover.joint && !hover.why) {
    context.globalAlpha = 0.75;
    context.beginPath();
    context.arc(left, top, 9 * dot, 0, 2 * Math.PI);
    context.fillStyle = "#ffffff";
    context.fill();
    context.strokeStyle = colour;
    context.lineWidth = 2.5 * dot;
    context.stroke();
    context.beginPath();
    context.arc(left, top, 3 * dot, 0, 2 * Math.PI);
    context.fillStyle = colour;
    context.fill();
    context.globalAlpha = 1;
  }
  label(paper, landingWords(editor, hover), left, top, colour);
}

/** Words beside a point of the canvas, within the picture. @param {Paper} paper @param {string} text @param {number} left @param {number} top @param {string} colour */
function label({ context, dot }, text, left, top, colour) {
  context.font = `600 ${12 * dot}px sans-serif`;
  const width = context.measureText(text).width + 12 * dot;
  const at = Math.max(4 * dot, Math.min(left + 16 * dot, context.canvas.width - width - 4 * dot));
  const up = top > 52 * dot ? top - 38 * dot : top + 18 * dot;
  context.beginPath();
  context.roundRect(at, up, width, 22 * dot, 4 * dot);
  context.fillStyle = "rgba(255, 255, 255, 0.95)";
  context.fill();
  context.strokeStyle = colour;
  context.lineWidth = dot;
  context.stroke();
  context.fillStyle = colour;
  context.textAlign = "left";
  context.textBaseline = "middle";
  context.fillText(text, at + 6 * dot, up + 11 * dot);
}

/** @param {Paper} paper @param {Point} at */
function cross(paper, [x, y]) {
  const reach = (8 * paper.dot) / paper.scale;
  for (const end of /** @type {Point[]} */ ([[reach, 0], [0, reach]])) {
    line(paper, [[x - end[0], y - end[1]], [x + end[0], y + end[1]]], "#d55e00", []);
  }
}
