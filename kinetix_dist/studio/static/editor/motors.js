// Motors of joints: the one that a joint is drawn with, and in words which way "forward" goes.
import { keyMark, MOTOR_KEYS } from "../play/play.js";

/** @typedef {import("./document.js").Level} Level */

/**
 * A wheel is a circle that moves and that a revolute joint holds to another shape or a wall: of a level file forward, by the key
 * of its motor, rolls it to the right where its speed as `b` is negative (docs/level_format.md).
 * @param {Level} document @param {any} joint @returns {"a" | "b" | null} which end is a wheel
 */
export function wheelOf(document, joint) {
  const isCircle = (/** @type {string} */ id) => document.shapes.some((shape) => shape.id === id && shape.type === "circle");
  const moves = (/** @type {string} */ id) => document.shapes.some((shape) => shape.id === id && !shape.fixed);
  if (joint.type !== "revolute" || isCircle(joint.a) === isCircle(joint.b)) return null;
  const end = isCircle(joint.a) ? "a" : "b";
  return moves(joint[end]) ? end : null;
}

/** Motor that a joint gets: forward rolls a wheel to the right. @param {Level} document @param {any} joint without a motor */
export const newMotor = (document, joint) => ({ speed: wheelOf(document, joint) === "b" ? -1 : 1, power: 1, colour: 0 });

/** @param {Level} document @param {any} joint with a motor @returns {string} what forward does, in one line */
export function forwardWords(document, joint) {
  const { speed = 1, colour = 0, auto = false } = joint.motor;
  const who = auto ? "It always runs forward, which" : `Forward (${keyMark((MOTOR_KEYS[colour] ?? MOTOR_KEYS[0])[0])})`;
  if (!speed) return `${who} brakes, and so does backward: its speed is 0.`;
  if (joint.type === "prismatic") return `${who} pushes ${joint.b} ${speed > 0 ? "along" : "against"} the axis.`;
  const wheel = wheelOf(document, joint);
  if (wheel === null) return `${who} turns ${joint.b} ${speed > 0 ? "counter-clockwise" : "clockwise"} against ${joint.a}.`;
  const isRight = speed > 0 === (wheel === "a");
  return `${who} rolls the wheel to the ${isRight ? "right" : "left"}. With the wheel as ${wheel}, ${wheel === "b" ? "negative" : "positive"} speeds roll to the right.`;
}
