// Ready-made mechanisms: the engine worker has them, the page puts them where there is room.
import { channel } from "../base/channel.js";
import { boundsOf, WORLD_M } from "./document.js";
import { pasted } from "./edits.js";
import { rounded } from "./geometry.js";
import { wheelOf } from "./motors.js";
import { countsOf, lacking, largerSize, sum } from "./sizes.js";

/**
 * @typedef {import("./state.js").Editor} Editor
 * @typedef {import("./document.js").Level} Level
 * @typedef {import("./edits.js").Copied} Copied
 * @typedef {[number, number, number, number]} Bounds
 */

const STEP_M = 0.1; // between the spots that are tried
const REACH_M = 4.6; // to each side
const APART_M = 0.02; // from other shapes, to the sides
const LIFT = 3; // a metre up or down counts as so many to the side: cars stay on the floor

/** Replies of the engine by mechanism and size. @type {Map<string, Promise<Copied>>} */
const replies = new Map();

/** @param {string} name @param {string} size @returns {Promise<Copied>} */
function requested(name, size) {
  const key = `${name} ${size}`;
  const reply = replies.get(key) ?? channel.request("mechanism", { mechanism: name, size }).then((answer) => driving(name, /** @type {any} */ (answer)));
  replies.set(key, reply);
  reply.catch(() => replies.delete(key));
  return reply;
}

/** The part with names after the mechanism, and wheels that forward rolls to the right. @param {string} name @param {Copied} part @returns {Copied} */
function driving(name, { shapes, joints, thrusters }) {
  const names = new Map(shapes.map((shape, k) => [shape.id, `${name}_${k + 1}`]));
  const named = { format: "", shapes: shapes.map((shape) => ({ ...shape, id: names.get(shape.id) ?? shape.id })), joints: joints.map((joint) => ({ ...joint, a: names.get(joint.a), b: names.get(joint.b) })), thrusters: thrusters.map((thruster) => ({ ...thruster, shape: names.get(thruster.shape) })) };
  const rolling = named.joints.map((joint) => {
    const wheel = joint.motor ? wheelOf(/** @type {any} */ (named), joint) : null;
    return wheel ? { ...joint, motor: { ...joint.motor, speed: (wheel === "a" ? 1 : -1) * Math.abs(joint.motor.speed) } } : joint;
  });
  return { ...named, joints: rolling };
}

/** Puts a mechanism at a free spot, as one step of the history. @param {Editor} editor @param {string} name
 * @param {string | null} [larger] size that the level gets with it */
export async function addMechanism(editor, name, larger = null) {
  const { sizes } = editor.engine;
  const size = larger ?? editor.settled.size;
  if (!(size in sizes)) return editor.notify(`the level has no size; choose one of ${Object.keys(sizes).join(", ")}`);
  const waiting = setTimeout(() => editor.notify(`the engine makes a ${name}; the first time it compiles, some seconds ...`), 200);
  try {
    const part = await requested(name, size);
    const level = larger ? { ...editor.settled, size: larger } : editor.settled; // as it is now
    const problem = lacking(sizes, level, part);
    if (problem) return refuse(editor, name, level, part, problem);
    return place(editor, name, level, part);
  } catch (error) {
    return editor.notify(`there is no ${name}: ${error instanceof Error ? error.message : error}`);
  } finally {
    clearTimeout(waiting);
  }
}

/** @param {Editor} editor @param {string} name @param {Level} level @param {Copied} part @param {string} problem */
function refuse(editor, name, level, part, problem) {
  const larger = largerSize(editor.engine.sizes, level.size, sum(countsOf(level), countsOf(part)));
  const text = `the ${name} needs ${problem}`;
  if (!larger) return editor.notify(`${text}; remove some first`);
  return editor.notify(text, { label: `use size ${larger.toUpperCase()} and add it`, run: () => void addMechanism(editor, name, larger) });
}

/** @param {Editor} editor @param {string} name @param {Level} level @param {Copied} part */
function place(editor, name, level, part) {
  const isGreen = [...level.shapes, ...Object.values(level.walls ?? {})].some((holder) => holder.role === "green");
  const given = isGreen ? { ...part, shapes: part.shapes.map(({ role: _, ...shape }) => /** @type {any} */ (shape)) } : part;
  const step = freeStep(level, part, editor.walls);
  const { document, selection } = pasted(level, given, step ?? [0, 0], editor.walls);
  editor.use("select");
  editor.commit(document, selection);
  const words = [`${/^[aeiou]/.test(name) ? "an" : "a"} ${name}; drag it to where it belongs`];
  if (!step) words.push("there was no free spot: it overlaps");
  if (isGreen) words.push("it has no green part: the level has a green shape");
  editor.notify(words.join(" · "));
}

/** The shortest step to where the part touches nothing; null: there is no such spot.
 * @param {Level} level @param {Copied} part @param {readonly import("./document.js").Wall[]} walls @returns {import("./geometry.js").Point | null} */
function freeStep(level, part, walls) {
  const taken = [...level.shapes.map(boundsOf), ...walls.map(({ position: [x, y], half_extents: [w, h] }) => /** @type {Bounds} */ ([x - w, y - h, x + w, y + h]))];
  const own = part.shapes.map(boundsOf);
  const steps = Array.from({ length: Math.round((2 * REACH_M) / STEP_M) + 1 }, (_, k) => rounded(k * STEP_M - REACH_M));
  /** @type {[number, number][]} */
  const all = steps.flatMap((dx) => steps.map((dy) => /** @type {[number, number]} */ ([dx, dy])));
  const length = (/** @type {[number, number]} */ [dx, dy]) => Math.abs(dx) + LIFT * Math.abs(dy);
  all.sort((a, b) => length(a) - length(b));
  const isFree = (/** @type {[number, number]} */ [dx, dy]) =>
    own.every(([left, bottom, right, top]) => {
      const isInside = left + dx > 0 && right + dx < WORLD_M && top + dy < WORLD_M;
      return isInside && taken.every((other) => right + dx < other[0] - APART_M || left + dx > other[2] + APART_M || top + dy < other[1] || bottom + dy > other[3]);
    });
  return all.find(isFree) ?? null;
}
