// The picture of the editor: draws the level or what is played, and turns pointers into gestures.
import { html, useEffect, useRef } from "../base/html.js";
import { drawPlay } from "../play/picture.js";
import { drawWorld, paperOf } from "../world/canvas.js";
import { levelPicture } from "../world/display_list.js";
import { cursorPointer } from "./commands.js";
import { drawOverlay } from "./overlay.js";
import { TOOLS } from "./tools.js";

const FINGER = 1.8; // how much farther a finger reaches than a mouse
const WHEEL_FACTOR = 1.0015; // of the view, for each pixel of a wheel

/**
 * @typedef {import("./geometry.js").Point} Point
 * @typedef {import("./state.js").Editor} Editor
 */

/** Visible part of the world, m: lowest x, lowest y, highest x, highest y. @param {HTMLCanvasElement} canvas @param {Editor["view"]} view */
function seen(canvas, view) {
  const scale = Math.min(canvas.width, canvas.height) / view.metres;
  const [x, y] = view.middle;
  const [halfX, halfY] = [canvas.width / 2 / scale, canvas.height / 2 / scale];
  return [x - halfX, y - halfY, x + halfX, y + halfY];
}

/** @param {{ editor: Editor, play: import("../play/play.js").Play }} props */
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
    const end = followPointers(element, editor, play, want);
    return () => {
      observer.disconnect();
      editor.listeners.delete(want);
      cancelAnimationFrame(wanted);
      end();
    };
  }, [editor, play]);
  return html`<canvas class="world editor-canvas" ref=${canvas} tabindex="0" aria-label="the level; keys: see Help"></canvas>`;
}

/** @param {HTMLCanvasElement} canvas @param {Editor} editor @param {import("../play/play.js").Play} play */
function draw(canvas, editor, play) {
  const { palette } = editor.engine;
  const view = seen(canvas, editor.view);
  if (drawPlay(canvas, play, palette, view)) return;
  delete canvas.dataset.step;
  const { hover } = TOOLS[editor.tool];
  if (editor.cursor && hover) editor.hover = hover(editor, cursorPointer(editor));
  canvas.style.cursor = !editor.hover ? "" : editor.hover.joint ? "pointer" : editor.hover.why ? "not-allowed" : "copy";
  const { display, poses } = levelPicture(editor.document, editor.engine);
  drawWorld(canvas, display, poses, palette, { letters: true, view });
  drawOverlay(paperOf(canvas, view), editor);
}

/** Pointers of mouse, pen and fingers. One draws, two pinch and pan. @param {HTMLCanvasElement} canvas @param {Editor} editor
 * @param {import("../play/play.js").Play} play @param {() => void} want draws the picture again @returns {() => void} */
function followPointers(canvas, editor, play, want) {
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
    if (!before) return hover(event);
    if (down.size === 2) pinch(event, before);
    down.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (down.size === 1) gesture?.move(pointer(event));
  };
  const hover = (/** @type {PointerEvent} */ event) => {
    if (play.isOpen || event.pointerType === "touch" || editor.sketch?.kind === "corners") return;
    const { hover: lands } = TOOLS[editor.tool];
    if (!lands && !editor.hover) return;
    editor.cursor = null;
    editor.hover = lands?.(editor, pointer(event)) ?? null;
    want();
  };
  const leave = () => {
    if (!editor.hover || down.size || editor.cursor) return;
    editor.hover = null;
    editor.guides = [];
    want();
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
    hover(event);
  };
  const wheel = (/** @type {WheelEvent} */ event) => {
    event.preventDefault();
    editor.zoom(WHEEL_FACTOR ** event.deltaY, world(event.clientX, event.clientY));
  };
  canvas.addEventListener("pointerdown", start);
  canvas.addEventListener("pointermove", move);
  canvas.addEventListener("pointerup", end);
  canvas.addEventListener("pointercancel", end);
  canvas.addEventListener("pointerleave", leave);
  canvas.addEventListener("wheel", wheel, { passive: false });
  return () => {
    canvas.removeEventListener("pointerdown", start);
    canvas.removeEventListener("pointermove", move);
    canvas.removeEventListener("pointerup", end);
    canvas.removeEventListener("pointercancel", end);
    canvas.removeEventListener("pointerleave", leave);
    canvas.removeEventListener("wheel", wheel);
  };
}
