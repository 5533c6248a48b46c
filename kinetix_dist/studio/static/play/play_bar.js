// Below the picture while a level is played: run, step, seek, speed, take over; buttons for fingers; what a policy thinks.
import { get, useRequest } from "../base/api.js";
import { percent, short } from "../base/format.js";
import { html } from "../base/html.js";
import { boundColours, keyMark, MOTOR_KEYS, nameOfColour, NUM_MOTOR_COLOURS, SPEEDS, THRUSTER_KEYS } from "./play.js";

/** Policy for the engine worker, of the key of a select. @param {string} name @returns {any} */
export function policyOf(name) {
  const [kind, ...rest] = name.split(":");
  return rest.length ? { [kind]: rest.join(":") } : kind;
}

/** Key of a select, of a policy for the engine worker: "keys", "checkpoint:generalist"; "actions" whatever they are. @param {any} policy */
function keyOfPolicy(policy) {
  if (typeof policy === "string") return policy;
  const [[kind, value]] = Object.entries(policy);
  return kind === "actions" ? kind : `${kind}:${value}`;
}

/** @type {Record<string, string>} */
const PLAYERS = { keys: "you, by keys", random: "random actions", noop: "no actions", actions: "the proof" };

/** Who that is. @param {string} key of a select */
export function playerWords(key) {
  const [kind, ...rest] = key.split(":");
  return PLAYERS[key] ?? `${kind === "run" ? "run " : ""}${rest.join(":")}`;
}

/** @param {{ value: string, choose: (name: string) => void, engine: any, people?: boolean, label: string }} props people: that keys are offered */
export function PolicyChoice({ value, choose, engine, people = true, label }) {
  const runs = useRequest(() => get("runs"), []);
  const offered = [
    ...(people ? ["keys"] : []),
    "random",
    "noop",
    ...engine.pretrained.map((/** @type {string} */ name) => `checkpoint:${name}`),
    ...(runs.data?.runs ?? []).map((/** @type {any} */ run) => `run:${run.id}`),
  ];
  const options = offered.includes(value) ? offered : [...offered, value];
  return html`<select aria-label=${label} value=${value} onChange=${(/** @type {any} */ e) => choose(e.target.value)}>
    ${options.map((key) => html`<option key=${key} value=${key}>${playerWords(key)}</option>`)}</select>`;
}

/** Who plays, or will: while a level is played another choice plays it anew. @param {{ play: import("./play.js").Play, value: string, choose: (name: string) => void, engine: any }} props */
export function PlayerChoice({ play, value, choose, engine }) {
  const chosen = (/** @type {string} */ name) => {
    choose(name);
    if (!play.isOpen) return;
    if (document.activeElement instanceof HTMLElement) document.activeElement.blur(); // keys are for the level now
    void play.again(policyOf(name));
  };
  return html`<${PolicyChoice} value=${play.isOpen ? keyOfPolicy(play.policy) : value} choose=${chosen} engine=${engine} label="who plays" />`;
}

/** @param {{ play: import("./play.js").Play, children?: any }} props */
export function PlayBar({ play, children }) {
  const { session, frame } = play;
  const isPerson = session?.policy.kind === "keys";
  if (play.problem && !session) return html`<div class="play-bar"><p class="bad" role="alert">${play.problem}</p>${children}</div>`;
  if (!session || !frame) return html`<div class="play-bar"><p class="soft" role="status">preparing: the first play of a size is compiled, some seconds ...</p></div>`;
  return html`<div class="play-bar">
    <div class="row">
      <button onClick=${() => play.control(play.isRunning ? "pause" : "run")} title="P">${play.isRunning ? "❚❚ pause" : "▶ go on"}</button>
      <button onClick=${() => play.control("seek", { step: Math.max(0, frame.step - 1) })} aria-label="one step back" title=",">◀</button>
      <button onClick=${() => play.control("step", { steps: 1 })} aria-label="one step on" title=".">▶</button>
      <input type="range" min="0" max=${play.last} value=${frame.step} aria-label="step" onInput=${(/** @type {any} */ e) => play.control("seek", { step: Number(e.target.value) })} />
      <select aria-label="speed" onChange=${(/** @type {any} */ e) => play.control("speed", { speed: Number(e.target.value) })}>
        ${SPEEDS.map((value) => html`<option key=${value} value=${value} selected=${value === play.speed}>${value} x</option>`)}</select>
      <button onClick=${() => play.control("reset").then(() => play.control("run"))} title="Backspace">↺ from the start</button>
      <button onClick=${() => play.control("take_over", { policy: "keys" })} title="play on from this step by keys">take over</button>
      ${children}
    </div>
    <p class="play-state" role="status" data-outcome=${play.outcome}><b>${playerWords(keyOfPolicy(play.policy))}</b> · step ${frame.step} of ${session.max_steps} · ${(frame.step * session.step_seconds).toFixed(1)} s · reward ${short(frame.reward)} · return ${frame.total.toFixed(3)} · <span title="from edge to edge; touching in any physics step solves the level">${play.isSolved ? "green touched blue" : `green is ${gapText(frame.gap)} from blue`}</span>${play.outcome ? html` · <b>${play.outcome}</b>` : ""}${session.exact ? "" : " · simulated again"}${play.isStored ? " · from the stored arrays" : ""}</p>
    ${play.problem ? html`<p class="bad" role="alert">${play.problem}</p>` : null}
    ${isPerson ? html`<${Pads} play=${play} />` : html`<${Mind} play=${play} />`}
  </div>`;
}

/** Buttons that are held, one for each way of each motor and each thruster of the level. @param {{ play: import("./play.js").Play }} props */
function Pads({ play }) {
  const { session } = play;
  if (!session) return null;
  const bound = boundColours(session);
  const motors = bound.filter((colour) => colour < NUM_MOTOR_COLOURS);
  const thrusters = bound.filter((colour) => colour >= NUM_MOTOR_COLOURS).map((colour) => colour - NUM_MOTOR_COLOURS);
  const pad = (/** @type {string} */ key, /** @type {string} */ label) => html`<button key=${key} class="pad" aria-pressed=${play.pressed.has(key)} aria-label=${label}
    onPointerDown=${(/** @type {PointerEvent} */ e) => { e.preventDefault(); /** @type {Element} */ (e.currentTarget).setPointerCapture(e.pointerId); play.press(key, true); }}
    onPointerUp=${() => play.press(key, false)} onPointerCancel=${() => play.press(key, false)}>${keyMark(key)}</button>`;
  return html`<div class="row pads">
    ${motors.map((colour) => html`<span key=${colour}>motor ${colour} ${[...MOTOR_KEYS[colour]].reverse().map((key) => pad(key, `motor ${colour} ${key === MOTOR_KEYS[colour][0] ? "forward" : "backward"}`))}</span>`)}
    ${thrusters.map((colour) => html`<span key=${`t${colour}`}>thruster ${colour} ${pad(THRUSTER_KEYS[colour], `thruster ${colour}`)}</span>`)}
    ${bound.length ? null : html`<span class="soft">your keys drive nothing here</span>`}
  </div>`;
}

/** The value of the state and what the policy makes of each control that the level has. @param {{ play: import("./play.js").Play }} props */
function Mind({ play }) {
  const { session, frame } = play;
  const heads = session?.policy.heads;
  if (!session || !frame || !heads) return null;
  if (frame.outputs.length !== heads.controls.length) return html`<div class="mind"><p class="soft">this step was not played by ${playerWords(keyOfPolicy(play.policy))}</p></div>`;
  const isChoice = heads.kind === "probabilities";
  const bound = boundColours(session);
  const groups = [...bound, ...(heads.controls.some((/** @type {any} */ [colour]) => colour === null) ? [null] : [])].map((colour) => ({
    name: colour === null ? "nothing" : nameOfColour(colour),
    parts: heads.controls
      .map((/** @type {[number | null, number | null]} */ [own, value], /** @type {number} */ k) => ({ own, value, number: frame.outputs[k] }))
      .filter((/** @type {any} */ part) => part.own === colour),
  }));
  return html`<div class="mind" data-value=${frame.value}><p>value <b>${frame.value.toFixed(3)}</b> <span class="soft">of ${playerWords(keyOfPolicy(play.policy))}${play.isAtEnd ? ", of the step before the end" : ""}, ${isChoice ? "probability of each choice" : "mean and spread"}:</span></p>
    ${bound.length ? null : html`<p class="soft">the policy drives nothing here</p>`}
    <div class="heads">${groups.map(({ name, parts }) => html`<div key=${name}><span class="soft">${name}</span>
      ${isChoice
        ? parts.map((/** @type {any} */ { own, value, number }, /** @type {number} */ k) => html`<span key=${k} class="chance"><meter min="0" max="1" value=${number}></meter>${nameOfChoice(own, value)} ${percent(number)}</span>`)
        : html`<span class="chance">${parts.map((/** @type {any} */ part) => part.number.toFixed(2)).join(" ± ")}</span>`}</div>`)}</div></div>`;
}

/** @param {number} metres */
const gapText = (metres) => (metres < 0.01 ? `${(1000 * metres).toFixed(1)} mm` : `${metres.toFixed(2)} m`);

/** @param {number | null} colour @param {number} value the value that the choice sets */
function nameOfChoice(colour, value) {
  if (!value) return "off";
  return colour === null || colour >= NUM_MOTOR_COLOURS ? "on" : value > 0 ? "+" : "-";
}
