// Levels in and out: files of the command line, dropped and pasted files, downloads, links, drafts, pictures.
import { get } from "../base/api.js";
import { channel } from "../base/channel.js";
import { download } from "../base/format.js";
import { drawWorld } from "../world/canvas.js";
import { levelPicture } from "../world/display_list.js";
import { setClipboard, paste } from "./commands.js";
import { documentText } from "./document.js";
import { COPIED_FORMAT } from "./edits.js";
import { linked, levelTextOf } from "./links.js";

/** @typedef {import("./state.js").Editor} Editor */

export const MAX_TEXT = 3_000_000; // characters; a message to the server has at most 4 MiB
const PICTURE_PIXELS = 1048;
const DRAFT = "kinetix-dist draft";
const STORED = /^runs\/([^/]+)\/curriculum\/(refresh|buffer)\/(\d+)\/levels\/(\d+)\/document$/;
const EVALUATED = /^runs\/([^/]+)\/evaluations\/document\?(.+)$/;

/** A level of the text of a file in either format. Throws an Error with one line.
 * @param {string} text @returns {Promise<import("./document.js").Level>} */
export async function readLevel(text) {
  if (text.length > MAX_TEXT) throw new Error(`this is too large for a level: ${(text.length / 1e6).toFixed(1)} MB; a level has a few kB`);
  let document;
  try {
    document = JSON.parse(text);
  } catch (error) {
    throw new Error(`this is not JSON (${error instanceof Error ? error.message : error})`);
  }
  if (document === null || typeof document !== "object" || Array.isArray(document)) throw new Error("this is no level: it is no JSON object");
  if ("env_state" in document) document = (await channel.request("convert", { document, to: "kinetix-dist" })).document;
  if (!Array.isArray(document.shapes)) throw new Error("this is no level: it has no list of shapes");
  const all = ["shapes", "joints", "thrusters"].map((part) => document[part] ?? []);
  if (!all.every(Array.isArray)) throw new Error("this is no level: joints and thrusters are lists");
  if (all.some((part) => part.length > 1000)) throw new Error("this is too large for a level: more than 1,000 shapes, joints or thrusters");
  if (all.some((part) => part.some((/** @type {any} */ element) => element === null || typeof element !== "object"))) throw new Error("this is no level: shapes, joints and thrusters are objects");
  return document;
}

/** Opens a level or a link to one that is dropped or pasted, or pastes a part that was copied. @param {Editor} editor @param {string} text */
export async function openText(editor, text) {
  try {
    const part = text.includes(COPIED_FORMAT) ? JSON.parse(text) : null;
    if (part?.format === COPIED_FORMAT) {
      setClipboard(part);
      paste(editor, part);
      return;
    }
    const packed = linked(text);
    editor.open(await readLevel(packed === null ? text : await levelTextOf(packed)));
    editor.notify("opened; undo brings back the level before");
  } catch (error) {
    editor.notify(error instanceof Error ? error.message : String(error));
  }
}

/** A level of a run's buffer, or of one of its evaluation sets. @param {Editor} editor @param {string} address below api/, of its document */
export async function openStored(editor, address) {
  const document = await get(address);
  const [, run, kind, number, index] = STORED.exec(address) ?? [];
  const [, evaluated, query] = EVALUATED.exec(address) ?? [];
  editor.open(document);
  if (evaluated) {
    const of = new URLSearchParams(query);
    editor.stored = { text: documentText(document), level: { run: decodeURIComponent(evaluated), set: of.get("set"), index: Number(of.get("index")), name: of.get("name") } };
  }
  if (run) editor.stored = { text: documentText(document), level: { run: decodeURIComponent(run), [kind]: Number(number), index: Number(index) } };
}

/** @param {string} name @returns {Promise<{ name: string, text: string, hash: string }>} */
export async function readFile(name) {
  const answer = await fetch(address(name));
  const content = await answer.json();
  if (!answer.ok) throw new Error(content.error);
  return content;
}

/** @param {Editor} editor @param {string} name */
export async function openFile(editor, name) {
  const { text, hash } = await readFile(name);
  const isPublic = text.includes('"env_state"');
  // A file of the other format is not written over: what is made of it is another level.
  editor.open(await readLevel(text), isPublic ? {} : { file: name, hash });
}

/** @typedef {{ name: string, problem: string, hash: string | null }} Conflict hash: of what is there instead; null: nothing */

/** Saves to a file of the command line, if it is what it was. @param {Editor} editor @param {string} name
 * @param {Conflict | null} over what a person agreed to lose @returns {Promise<Conflict | null>} null: saved, or the reason was shown */
export async function saveFile(editor, name, over = null) {
  const { document } = editor;
  const text = documentText(document);
  const known = over ? over.hash : (editor.files.get(name)?.hash ?? null);
  /** @type {Record<string, string>} */
  const headers = known === null ? { "If-None-Match": "*" } : { "If-Match": `"${known}"` };
  const answer = await fetch(address(name), { method: "PUT", body: text, headers }).catch(() => null);
  if (!answer) {
    editor.notify("not saved: the server does not answer");
    return null;
  }
  const content = await answer.json();
  if (answer.status === 412) {
    return { name, problem: content.error, hash: content.hash };
  }
  if (!answer.ok) {
    editor.notify(`not saved: ${content.error}`);
    return null;
  }
  editor.files.set(name, { hash: content.hash, text });
  if (editor.file !== name) editor.commit(document, editor.selection, name);
  editor.notify(`saved to ${name}`);
  return null;
}

/** @param {string} name */
const address = (name) => `api/files/${name.split("/").map(encodeURIComponent).join("/")}`;

/** @param {Editor} editor @param {"kinetix-dist" | "public"} format */
export async function downloadLevel(editor, format) {
  try {
    const { document } = editor;
    const isOurs = format === "kinetix-dist";
    const text = isOurs ? documentText(document) : JSON.stringify((await channel.request("convert", { document, to: format })).document);
    download(`${fileName(document)}${isOurs ? "" : ".public"}.json`, new Blob([text], { type: "application/json" }));
  } catch (error) {
    editor.notify(error instanceof Error ? error.message : String(error));
  }
}

/** @param {Editor} editor */
export function downloadPicture(editor) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = PICTURE_PIXELS;
  const { display, poses } = levelPicture(editor.document, editor.engine);
  drawWorld(canvas, display, poses, editor.engine.palette, { letters: true });
  canvas.toBlob((blob) => blob && download(`${fileName(editor.document)}.png`, blob), "image/png");
}

/** @param {{ name?: any }} document */
const fileName = (document) => String(document.name ?? "").replace(/[^\w-]+/g, "_").replace(/^_+|_+$/g, "") || "level";

/** Draft of the level, stored by the browser until it is saved. @param {Editor} editor */
export function keepDraft(editor) {
  const { document, file } = editor.history.present;
  if (!editor.history.past.length || !editor.isUnsaved) return;
  try {
    localStorage.setItem(DRAFT, JSON.stringify({ text: documentText(document), file, at: Date.now() }));
  } catch {
    editor.notify("the browser stores no draft: its storage is full or off");
  }
}

/** @returns {{ text: string, file: string | null, at: number } | null} */
export function findDraft() {
  try {
    return JSON.parse(localStorage.getItem(DRAFT) ?? "null");
  } catch {
    return null; // of another version
  }
}

export const dropDraft = () => localStorage.removeItem(DRAFT);
