// A pointer over the picture: mouse, pen, finger or the cross of the keyboard.
import { roundedPoint } from "./geometry.js";
import { snapped, snapTargets } from "./snap.js";

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("./state.js").Editor} Editor
 * @typedef {{ at: Point, px: number, thick: number, add: boolean, free: boolean }} Pointer at: m; px: m of a pixel; thick: 1 of a mouse; add: shift is held; free: no snapping
 * @typedef {{ move: (pointer: Pointer) => void, up: (pointer: Pointer) => void }} Gesture
 */

export const CLICK_PX = 5; // less is no drag
export const THING_PX = 8; // how near a pointer has to come to joints and thrusters, and to shapes that a tool joins or pushes

/** Snapped point of the pointer. @param {Editor} editor @param {Pointer} pointer @param {ReadonlySet<string>} [but] @returns {Point} */
export function aimed(editor, pointer, but) {
  editor.guides = [];
  if (!editor.snaps || pointer.free) return roundedPoint(pointer.at);
  const { point, guides } = snapped(pointer.at, snapTargets(editor.settled, editor.walls, pointer.at, but), pointer.px);
  editor.guides = guides;
  return roundedPoint(point);
}
