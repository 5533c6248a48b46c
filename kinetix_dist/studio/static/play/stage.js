// A level that is played in place: its picture, who plays, the bar of play, keys while the picture has the focus.
import { html, useEffect, useMemo, useRef, useState } from "../base/html.js";
import { useListeners } from "../base/listeners.js";
import { drawWorld, VIEW } from "../world/canvas.js";
import { drawPlay } from "./picture.js";
import { Play, playKey } from "./play.js";
import { PlayBar, PlayerChoice, policyOf } from "./play_bar.js";

/**
 * `given`: the level as the engine worker calls it; `run`: whose newest checkpoint is proposed, and whose environment is
 * played. `still`: the picture while nothing is played.
 * @param {{ given: any, run: string, engine: any, still: { display: import("../world/canvas.js").Display, poses: number[][] },
 *   size: number, label: string }} props
 */
export function PlayStage({ given, run, engine, still, size, label }) {
  const canvas = useRef(/** @type {HTMLCanvasElement | null} */ (null));
  const [policy, setPolicy] = useState(`run:${run}`);
  const { play, listeners } = useMemo(() => {
    /** @type {Set<() => void>} */
    const called = new Set();
    return { listeners: called, play: new Play(() => called.forEach((listener) => listener())) };
  }, []);
  useListeners(listeners);
  useEffect(() => () => void play.close(), [play]);
  useEffect(() => {
    const element = /** @type {HTMLCanvasElement} */ (canvas.current);
    const pixels = Math.round(size * (devicePixelRatio || 1));
    if (element.width !== pixels) element.width = element.height = pixels;
    if (drawPlay(element, play, engine.palette, VIEW)) return;
    delete element.dataset.step;
    drawWorld(element, still.display, still.poses.flat(), engine.palette, { letters: true });
  });
  const start = () => {
    if (play.isOpen) return void play.close();
    canvas.current?.focus();
    return void play.open(given, policyOf(policy), { env: { run } });
  };
  const press = (/** @type {KeyboardEvent} */ event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (event.key === " ") start();
    else if (!play.isOpen || !(playKey(play, event.key.toLowerCase()) || play.press(event.key, true))) return;
    event.preventDefault();
  };
  return html`<div class="stage">
    <canvas class="world" ref=${canvas} tabindex="0" role="img" aria-label=${label} style=${{ width: `min(${size}px, 100%)`, aspectRatio: "1" }}
      onKeyDown=${press} onKeyUp=${(/** @type {KeyboardEvent} */ event) => void play.press(event.key, false)} onBlur=${() => play.release()}></canvas>
    <div class="row small"><button class="primary" onClick=${start} title="space">${play.isOpen ? "■ stop" : "▶ play"}</button>
      <${PlayerChoice} play=${play} value=${policy} choose=${setPolicy} engine=${engine} /></div>
    ${play.isOpen || play.problem ? html`<${PlayBar} play=${play} />` : null}
  </div>`;
}
