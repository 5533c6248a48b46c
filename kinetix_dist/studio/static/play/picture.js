// The picture of a level that is played: the engine's own list and poses, and on each motor and thruster its key.
import { drawWorld, paperOf } from "../world/canvas.js";
import { keyMark, MOTOR_KEYS, THRUSTER_KEYS } from "./play.js";

/** @param {HTMLCanvasElement} canvas @param {import("./play.js").Play} play @param {import("../world/canvas.js").Palette} palette
 * @param {number[]} view what is seen, m @returns {boolean} whether there was a frame to draw */
export function drawPlay(canvas, play, palette, view) {
  const { session, frame } = play;
  if (!session || !frame) return false;
  drawWorld(canvas, session.display, frame.poses, palette, { thrust: frame.thruster, letters: true, view });
  drawKeys(paperOf(canvas, view), play);
  canvas.dataset.step = String(frame.step);
  return true;
}

/** On each motor and thruster the key that drives it; it is filled while it does. @param {import("../world/canvas.js").Paper} paper @param {import("./play.js").Play} play */
function drawKeys(paper, play) {
  const { session, frame } = play;
  if (!session || !frame) return;
  const colours = frame.colours;
  /** @type {Set<string>} */
  const done = new Set();
  for (const { part, body, points } of session.display.primitives) {
    const name = part.join(" ");
    if (done.has(name) || (part[0] !== "joint" && part[0] !== "thruster")) continue;
    const motor = part[0] === "joint" ? session.motors.find((/** @type {any} */ entry) => entry.joint === part[1]) : null;
    const thruster = part[0] === "thruster" ? session.thrusters.find((/** @type {any} */ entry) => entry.thruster === part[1]) : null;
    if (!motor && !thruster) continue;
    done.add(name);
    const [x, y, angle] = frame.poses.subarray(3 * body, 3 * body + 3);
    const [px, py] = points[0];
    /** @type {[number, number]} */
    const at = [x + Math.cos(angle) * px - Math.sin(angle) * py, y + Math.sin(angle) * px + Math.cos(angle) * py];
    if (motor?.auto) plate(paper, at, "auto", true);
    else if (motor) plate(paper, at, MOTOR_KEYS[motor.colour].map(keyMark).join(" "), colours[motor.colour] !== 0);
    else plate(paper, at, keyMark(THRUSTER_KEYS[thruster.colour]), colours[4 + thruster.colour] !== 0);
  }
}

/** A word on a plate, at a point of the world. @param {import("../world/canvas.js").Paper} paper @param {[number, number]} at
 * @param {string} text @param {boolean} isPressed */
function plate({ context, x, y, dot }, at, text, isPressed) {
  context.font = `600 ${12 * dot}px sans-serif`;
  const width = context.measureText(text).width + 8 * dot;
  const [left, top] = [x(at[0]) + 8 * dot, y(at[1]) - 22 * dot];
  context.fillStyle = isPressed ? "#0b62b8" : "rgba(255, 255, 255, 0.92)";
  context.strokeStyle = "#343640";
  context.lineWidth = dot;
  context.beginPath();
  context.roundRect(left, top, width, 18 * dot, 4 * dot);
  context.fill();
  context.stroke();
  context.fillStyle = isPressed ? "#ffffff" : "#343640";
  context.textAlign = "left";
  context.textBaseline = "middle";
  context.fillText(text, left + 4 * dot, top + 9 * dot);
}
