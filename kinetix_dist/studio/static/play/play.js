// A level played in the engine worker (docs/play_protocol.md): session, keys, frames. No picture of its own.
import { channel } from "../base/channel.js";

/** Keys of the six colours: four of motors, forward and backward, two of thrusters. */
export const MOTOR_KEYS = /** @type {const} */ ([["ArrowRight", "ArrowLeft"], ["ArrowUp", "ArrowDown"], ["d", "a"], ["w", "s"]]);
export const THRUSTER_KEYS = /** @type {const} */ (["1", "2"]);
const MARKS = { ArrowRight: "→", ArrowLeft: "←", ArrowUp: "↑", ArrowDown: "↓" };
export const NUM_MOTOR_COLOURS = MOTOR_KEYS.length;
const HEADER_BYTES = 28;
export const SPEEDS = [0.125, 0.25, 0.5, 1, 2];
const FLAGS = { done: 1, solved: 2, failed: 4, unstable: 8 };

/** Label of a key. @param {string} key */
export const keyMark = (key) => MARKS[/** @type {keyof typeof MARKS} */ (key)] ?? key.toUpperCase();

/** @typedef {{ step: number, reward: number, total: number, value: number, gap: number, flags: number, poses: Float32Array,
 *   motor: Float32Array, thruster: Float32Array, colours: Float32Array, outputs: Float32Array }} Frame */

/** Outputs of the policy are the rest: a policy that takes over has a frame before it is announced.
 * @param {ArrayBuffer} bytes @param {{ shapes: number, joints: number, thrusters: number }} sizes @returns {Frame} */
export function decodeFrame(bytes, sizes) {
  const view = new DataView(bytes);
  let start = HEADER_BYTES;
  const take = (/** @type {number} */ count) => {
    start += 4 * count;
    return new Float32Array(bytes, start - 4 * count, count);
  };
  const [reward, total, value, gap] = [12, 16, 20, 24].map((at) => view.getFloat32(at, true));
  return {
    flags: view.getUint8(1),
    step: view.getUint32(4, true),
    reward, total, value, gap,
    poses: take(3 * sizes.shapes),
    motor: take(sizes.joints),
    thruster: take(sizes.thrusters),
    colours: take(6),
    outputs: take((bytes.byteLength - start) / 4),
  };
}

/** Colours that drive something in the level, counted as those of a frame: motors 0 to 3, thrusters 4 and 5.
 * @param {import("../base/channel.js").Message} session @returns {number[]} */
export function boundColours(session) {
  const motors = session.motors.filter((/** @type {any} */ motor) => !motor.auto).map((/** @type {any} */ motor) => motor.colour);
  const thrusters = session.thrusters.map((/** @type {any} */ thruster) => NUM_MOTOR_COLOURS + thruster.colour);
  return [...new Set([...motors, ...thrusters])].sort();
}

/** @param {number} colour counted as those of a frame */
export const nameOfColour = (colour) => (colour < NUM_MOTOR_COLOURS ? `motor ${colour}` : `thruster ${colour - NUM_MOTOR_COLOURS}`);

export class Play {
  /** @param {() => void} changed */
  constructor(changed) {
    this.changed = changed;
    /** @type {import("../base/channel.js").Message | null} what play.open was answered */
    this.session = null;
    /** @type {Frame | null} */
    this.frame = null;
    this.isRunning = false;
    this.speed = 1;
    this.last = 0;
    this.outcome = "";
    this.problem = "";
    this.isOpening = false;
    this.opened = 0; // which opening is the newest: one that was closed, or followed by another, is closed when it comes
    this.isStored = false; // played from the arrays of a run's buffer
    /** What is played, for another player. @type {{ level: any, options: { seed?: number, env?: any } } | null} */
    this.given = null;
    /** Who plays, as the engine worker calls it. @type {any} */
    this.policy = null;
    /** @type {Set<string>} */
    this.pressed = new Set();
    this.sequence = 0;
  }

  get isOpen() {
    return this.session !== null || this.isOpening;
  }

  /** @param {any} level @param {any} policy @param {{ seed?: number, env?: any }} [options] */
  async open(level, policy, { seed = 0, env } = {}) {
    await this.close();
    const own = ++this.opened;
    this.isOpening = true;
    this.isStored = "run" in level;
    this.given = { level, options: { seed, env } };
    this.policy = policy;
    this.last = 0;
    this.changed();
    try {
      const session = await channel.request("play.open", { level, policy, env, seed, running: false });
      if (own !== this.opened) {
        await channel.request("play.close", { session: session.session }).catch(() => {}); // it is gone already
        return;
      }
      this.session = session;
      this.frame = null;
      channel.sessions.set(session.session, { frame: (bytes) => this.#show(bytes), end: (message) => this.#end(message) });
      if (this.pressed.size) this.#sendAction(); // keys that went down while it was prepared
      if (this.speed !== 1) await this.control("speed", { speed: this.speed });
      await this.control("run");
    } catch (error) {
      if (own !== this.opened) return;
      this.problem = error instanceof Error ? error.message : String(error);
    }
    if (own !== this.opened) return;
    this.isOpening = false;
    this.changed();
  }

  /** Plays the same level from its start, by another player. @param {any} policy */
  async again(policy) {
    if (this.given) await this.open(this.given.level, policy, this.given.options);
  }

  /** Ends what is played, and what was wrong with it is not shown any more. */
  async close() {
    this.opened += 1;
    const session = this.session?.session;
    this.problem = this.outcome = "";
    this.session = this.frame = null;
    this.isRunning = this.isOpening = false;
    this.pressed.clear();
    this.changed();
    if (session === undefined) return;
    channel.sessions.delete(session);
    await channel.request("play.close", { session }).catch(() => {}); // it is gone already
  }

  /** @param {string} what of `play.control` @param {Record<string, any>} [more] */
  async control(what, more = {}) {
    if (!this.session) return;
    if (what === "speed") this.speed = more.speed;
    try {
      const reply = await channel.request("play.control", { session: this.session.session, do: what, ...more });
      this.isRunning = reply.running;
      this.last = reply.last;
      if (what === "take_over") {
        this.session = { ...this.session, policy: reply.policy, sizes: reply.sizes };
        this.policy = more.policy;
      }
      // only now: the end of what was played before may come until the answer
      if (what === "reset" || what === "take_over" || (what === "seek" && reply.step < reply.last)) this.outcome = "";
    } catch (error) {
      this.problem = error instanceof Error ? error.message : String(error);
    }
    this.changed();
  }

  /** @param {string} key @param {boolean} isDown @returns {boolean} whether it is one of play */
  press(key, isDown) {
    const known = key.length === 1 ? key.toLowerCase() : key;
    if (![...MOTOR_KEYS.flat(), ...THRUSTER_KEYS].some((entry) => entry === known)) return false;
    if (this.pressed.has(known) === isDown) return true;
    if (isDown) this.pressed.add(known);
    else this.pressed.delete(known);
    this.#sendAction();
    return true;
  }

  release() {
    if (!this.pressed.size) return;
    this.pressed.clear();
    this.#sendAction();
  }

  /** Four motor colours {0 off, 1 forward, 2 backward}, two thruster colours {0, 1}. */
  get action() {
    const motors = MOTOR_KEYS.map(([forward, backward]) => (this.pressed.has(forward) ? 1 : this.pressed.has(backward) ? 2 : 0));
    return [...motors, ...THRUSTER_KEYS.map((key) => Number(this.pressed.has(key)))];
  }

  #sendAction() {
    if (this.session) channel.send({ type: "play.input", session: this.session.session, seq: ++this.sequence, action: this.action });
    this.changed();
  }

  /** @param {ArrayBuffer} bytes */
  #show(bytes) {
    if (!this.session) return;
    this.frame = decodeFrame(bytes, this.session.sizes);
    this.last = Math.max(this.last, this.frame.step);
    this.changed();
  }

  /** @param {import("../base/channel.js").Message} message */
  #end(message) {
    if (message.type === "play.end") {
      this.outcome = message.outcome;
      this.isRunning = false;
    } else {
      this.problem = message.text;
      this.session = this.frame = null;
      this.isRunning = false;
    }
    this.changed();
  }

  get isAtEnd() {
    return ((this.frame?.flags ?? 0) & FLAGS.done) !== 0;
  }

  get isSolved() {
    return ((this.frame?.flags ?? 0) & FLAGS.solved) !== 0;
  }
}

/** Keys besides those of motors and thrusters. @type {Record<string, [string, (play: Play) => void]>} */
export const PLAY_KEYS = {
  p: ["pause, or go on", (play) => void play.control(play.isRunning ? "pause" : "run")],
  ".": ["one step on", (play) => void play.control("step", { steps: 1 })],
  ",": ["one step back", (play) => void play.control("seek", { step: Math.max(0, (play.frame?.step ?? 0) - 1) })],
  backspace: ["from the start", (play) => void play.control("reset").then(() => play.control("run"))],
  escape: ["end", (play) => void play.close()],
};

/** @param {Play} play @param {string} key in lower case @returns {boolean} whether it is one of these */
export function playKey(play, key) {
  PLAY_KEYS[key]?.[1](play);
  return key in PLAY_KEYS;
}
