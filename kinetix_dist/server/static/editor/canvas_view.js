// The picture of the editor: draws the level or what is played, and turns pointers into gestures.
import { html, useEffect, useRef } from "../base/html.js";
import { drawWorld } from "../world/canvas.js";
import { levelPicture } from "../world/display_list.js";
import { drawOverlay, plate } from "./overlay.js";
import { keyMark, MOTOR_KEYS, THRUSTER_KEYS } from "./play.js";
import { TOOLS } from "./tools.js";

const FINGER = 1.8; // how much farther a finger reaches than a mouse
const WHEEL_FACTOR = 1.0015; // of the view, for each pixel of a wheel

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("./state.js").Editor} Editor
 */

/** What is seen, m: lowest x, lowest y, highest x, highest y. @param {HTMLCanvasElement} canvas @param {Editor["view"]} view */
function seen(canvas, view) {
  const scale = Math.min(canvas.width, canvas.height) / view.metres;
  const [x, y] = view.middle;
  const [halfX, halfY] = [canvas.width / 2 / scale, canvas.height / 2 / scale];
  return [x - halfX, y - halfY, x + halfX, y + halfY];
}

/** @param {{ editor: Editor, play: import("./play.js").Play }} props */
export function CanvasView({ editor, play }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));

  useEffect(() => {
    const element = /** @type {HTMLCanvasElement} */ (canvas.current);
    let wanted = 0;
    const want = () => {
      wanted ||= requestAnimationFrame(() => {
        wanted = 0;
        draw(element, editor, play);
      });
    };
    const resize = () => {
      const dot = devicePixelRatio || 1;
      element.width = Math.max(1, Math.round(element.clientWidth * dot));
      element.height = Math.max(1, Math.round(element.clientHeight * dot));
      want();
    };
    const observer = new ResizeObserver(resize);
    observer.observe(element);
    editor.listeners.add(want);
    const end = followPointers(element, editor, play);
    return () => {
      observer.disconnect();
      editor.listeners.delete(want);
      cancelAnimationFrame(wanted);
      end();
    };
  }, [editor, play]);
  return html`<canvas class="world editor-canvas" ref=${canvas} tabindex="0" aria-label="the level; keys: see Help"></canvas>`;
}

/** @param {HTMLCanvasElement} canvas @param {Editor} editor @param {import("./play.js").Play} play */
function draw(canvas, editor, play) {
  const { palette } = editor.engine;
  const view = seen(canvas, editor.view);
  const dot = devicePixelRatio || 1;
  const scale = canvas.width / (view[2] - view[0]);
  const paper = {
    context: /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d")),
    x: (/** @type {number} */ value) => (value - view[0]) * scale,
    y: (/** @type {number} */ value) => (view[3] - value) * scale,
    scale,
    dot,
  };
  if (play.session && play.frame) {
    const { display } = play.session;
    drawWorld(canvas, display, play.frame.poses, palette, { thrust: play.frame.thruster, letters: true, view });
    drawKeys(paper, play);
    canvas.dataset.step = String(play.frame.step);
    return;
  }
  delete canvas.dataset.step;
  const { display, poses } = levelPicture(editor.document, editor.engine);
  drawWorld(canvas, display, poses, palette, { letters: true, view });
  drawOverlay(paper, editor);
}

/** On each motor and thruster the key that drives it; it is filled while it does. @param {import("./overlay.js").Paper} paper @param {import("./play.js").Play} play */
function drawKeys(paper, play) {
  const { session, frame } = play;
  if (!session || !frame) return;
  const told = frame.colours;
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
    /** @type {Point} */
    const at = [x + Math.cos(angle) * px - Math.sin(angle) * py, y + Math.sin(angle) * px + Math.cos(angle) * py];
    if (motor?.auto) plate(paper, at, "auto", true);
    else if (motor) plate(paper, at, MOTOR_KEYS[motor.colour].map(keyMark).join(" "), told[motor.colour] !== 0);
    else plate(paper, at, keyMark(THRUSTER_KEYS[thruster.colour]), told[4 + thruster.colour] !== 0);
  }
}

/** Pointers of mouse, pen and fingers. One draws, two pinch and pan. @param {HTMLCanvasElement} canvas @param {Editor} editor
 * @param {import("./play.js").Play} play @returns {() => void} */
function followPointers(canvas, editor, play) {
  /** @type {Map<number, { x: number, y: number }>} */
  const down = new Map();
  /** @type {import("./tools.js").Gesture | null} */
  let gesture = null;
  const px = () => (editor.view.metres / Math.min(canvas.clientWidth, canvas.clientHeight)) || 1;
  const world = (/** @type {number} */ clientX, /** @type {number} */ clientY) => {
    const box = canvas.getBoundingClientRect();
    const [x, y] = editor.view.middle;
    return /** @type {Point} */ ([x + (clientX - box.left - box.width / 2) * px(), y - (clientY - box.top - box.height / 2) * px()]);
  };
  const pointer = (/** @type {PointerEvent} */ event) => ({
    at: world(event.clientX, event.clientY),
    px: px(),
    thick: event.pointerType === "touch" ? FINGER : 1,
    add: event.shiftKey || editor.adds,
    free: event.altKey,
  });
  const start = (/** @type {PointerEvent} */ event) => {
    canvas.focus();
    event.preventDefault();
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (down.size > 1) {
      editor.cancel();
      gesture = null;
      return;
    }
    editor.cursor = null;
    const isPan = event.button === 1 || play.isOpen;
    gesture = (isPan ? TOOLS.pan : TOOLS[editor.tool]).down(editor, pointer(event));
  };
  const move = (/** @type {PointerEvent} */ event) => {
    const before = down.get(event.pointerId);
    if (!before) return;
    if (down.size === 2) pinch(event, before);
    down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (down.size === 1) gesture?.move(pointer(event));
  };
  const pinch = (/** @type {PointerEvent} */ event, /** @type {{ x: number, y: number }} */ before) => {
    const other = [...down.entries()].find(([id]) => id !== event.pointerId)?.[1];
    if (!other) return;
    const apart = (/** @type {{ x: number, y: number }} */ one) => Math.hypot(one.x - other.x, one.y - other.y);
    const now = { x: event.clientX, y: event.clientY };
    editor.zoom(apart(before) / Math.max(apart(now), 1), world(other.x, other.y));
    editor.pan(/** @type {Point} */ ([((now.x - before.x) / 2) * px(), (-(now.y - before.y) / 2) * px()]));
  };
  const end = (/** @type {PointerEvent} */ event) => {
    if (!down.delete(event.pointerId)) return;
    const ended = gesture;
    gesture = null;
    if (event.type === "pointerup") ended?.up(pointer(event));
    else editor.cancel();
  };
  const wheel = (/** @type {WheelEvent} */ event) => {
    event.preventDefault();
    editor.zoom(WHEEL_FACTOR ** event.deltaY, world(event.clientX, event.clientY));
  };
  canvas.addEventListener("pointerdown", start);
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("wheel", wheel, { passive: false });
  return () => {
    canvas.removeEventListener("pointerdown", start);
    canvas.removeEventListener("pointermove", move);
    canvas.removeEventListener("pointerup", end);
    canvas.removeEventListener("pointercancel", end);
    canvas.removeEventListener("wheel", wheel);
  };
}
