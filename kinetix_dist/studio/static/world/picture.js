// One still picture of a world, and the palette that all pictures take from the server.
import { get } from "../base/api.js";
import { html, useEffect, useRef } from "../base/html.js";
import { drawWorld } from "./canvas.js";

/** @type {Promise<import("./canvas.js").Palette> | null} */
let palette = null;

/** Colours of all pictures; requested once, and again after an error. @returns {Promise<import("./canvas.js").Palette>} */
export function getPalette() {
  palette ??= get("palette").catch((error) => {
    palette = null;
    throw error;
  });
  return /** @type {Promise<import("./canvas.js").Palette>} */ (palette);
}

/**
 * @param {{ display: import("./canvas.js").Display, poses: number[][], palette: import("./canvas.js").Palette,
 *   size: number, letters?: boolean, label: string }} props
 */
export function Picture({ display, poses, palette: colours, size, letters, label }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  useEffect(() => {
    const element = /** @type {HTMLCanvasElement} */ (canvas.current);
    const scale = devicePixelRatio || 1;
    element.width = element.height = Math.round(size * scale);
    drawWorld(element, display, poses.flat(), colours, { letters });
  }, [display, poses, colours, size, letters]);
  return html`<canvas class="world" ref=${canvas} style=${{ width: `${size}px`, height: `${size}px` }} role="img" aria-label=${label}></canvas>`;
}
