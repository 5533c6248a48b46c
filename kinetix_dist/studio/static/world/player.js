// Shows a rollout: states as they were stored, never simulated again. Plays, steps, scrubs; space and arrow keys.
import { html, useEffect, useRef, useState } from "../base/html.js";
import { drawWorld } from "./canvas.js";

const SPEEDS = [0.125, 0.25, 0.5, 1, 2];

/**
 * @typedef {{ display: import("./canvas.js").Display, num_steps: number, step_seconds: number, outcome: string,
 *   name: string, arrays: Record<string, { shape: number[], values: Float32Array }> }} Rollout
 */

/**
 * A rollout of the bytes that the server sends: u32 size of the JSON | JSON | float32 arrays.
 * @param {ArrayBuffer} bytes @returns {Rollout & Record<string, any>}
 */
export function decodeRollout(bytes) {
  const length = new DataView(bytes).getUint32(0, true);
  const about = JSON.parse(new TextDecoder().decode(new Uint8Array(bytes, 4, length)));
  let start = 4 + length;
  /** @type {Rollout["arrays"]} */
  const arrays = {};
  for (const [name, shape] of about.arrays) {
    const count = shape.reduce((/** @type {number} */ product, /** @type {number} */ size) => product * size, 1);
    arrays[name] = { shape, values: new Float32Array(bytes, start, count) };
    start += 4 * count;
  }
  return { ...about, arrays };
}

/** @param {{ rollout: Rollout, palette: import("./canvas.js").Palette, size?: number }} props */
export function Player({ rollout, palette, size = 480 }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const stop = useRef(() => {});
  const [step, setStep] = useState(0);
  const [isRunning, setRunning] = useState(true);
  const [speed, setSpeed] = useState(1);
  const { num_steps: last, step_seconds: seconds, arrays } = rollout;
  const numShapes = arrays.poses.shape[1];

  useEffect(() => {
    const element = /** @type {HTMLCanvasElement} */ (canvas.current);
    element.width = element.height = Math.round(size * (devicePixelRatio || 1));
    const numThrusters = arrays.thruster.shape[1];
    // State k was reached by step k - 1: its flames are those of that step.
    const thrust = step ? arrays.thruster.values.subarray((step - 1) * numThrusters, step * numThrusters) : null;
    drawWorld(element, rollout.display, arrays.poses.values, palette, { start: 3 * numShapes * step, thrust, letters: true });
  }, [rollout, step, palette, size]);

  useEffect(() => {
    if (!isRunning) return undefined;
    let isCurrent = true;
    stop.current = () => {
      isCurrent = false; // at once: a picture that is due already must not overtake a key
    };
    const from = step >= last ? 0 : step;
    const began = performance.now();
    let frame = requestAnimationFrame(function show() {
      if (!isCurrent) return;
      const now = from + Math.floor(((performance.now() - began) / 1000 / seconds) * speed);
      setStep(Math.min(now, last));
      if (now < last) frame = requestAnimationFrame(show);
      else setRunning(false);
    });
    return () => cancelAnimationFrame(frame);
  }, [isRunning, speed, rollout]);

  const go = (/** @type {number} */ to) => {
    stop.current();
    setRunning(false);
    setStep(Math.min(Math.max(to, 0), last));
  };
  const press = (/** @type {KeyboardEvent} */ event) => {
    if (event.key === " ") setRunning(!isRunning);
    else if (event.key === "ArrowLeft") go(step - 1);
    else if (event.key === "ArrowRight") go(step + 1);
    else if (event.key === "Home") go(0);
    else if (event.key === "End") go(last);
    else return;
    event.preventDefault();
  };
  const sum = arrays.reward.values.subarray(0, step).reduce((total, value) => total + value, 0);
  return html`<div class="player" tabindex="0" onKeyDown=${press} aria-label=${`rollout of ${rollout.name}`}>
    <canvas class="world" ref=${canvas} style=${{ width: `min(${size}px, 100%)`, aspectRatio: "1" }} data-step=${step}></canvas>
    <div class="row">
      <button onClick=${() => setRunning(!isRunning)} title="space">${isRunning ? "❚❚ pause" : "▶ play"}</button>
      <button onClick=${() => go(step - 1)} aria-label="one step back">◀</button>
      <button onClick=${() => go(step + 1)} aria-label="one step on">▶</button>
      <input type="range" min="0" max=${last} value=${step} onInput=${(/** @type {any} */ e) => go(Number(e.target.value))} aria-label="step" />
      <select onChange=${(/** @type {any} */ e) => setSpeed(Number(e.target.value))} aria-label="speed">
        ${SPEEDS.map((value) => html`<option key=${value} value=${value} selected=${value === speed}>${value} x</option>`)}</select>
    </div>
    <p class="soft">step ${step} of ${last} · ${(step * seconds).toFixed(1)} s · return ${sum.toFixed(3)} ${step === last ? html`· <b>${rollout.outcome}</b>` : ""}</p>
  </div>`;
}
