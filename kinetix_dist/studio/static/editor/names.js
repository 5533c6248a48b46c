// Names of elements for people: in lists, headings, problems and warnings.
import { elementAt, parsePath } from "./document.js";

/** @typedef {import("./document.js").Level} Level */

/** Paths of elements, as the engine names them, with the field that follows: "shapes[1].motor.speed". */
const PATHS = /\b((?:shapes|joints|thrusters)\[\d+\]|walls\.\w+)((?:\.\w+|\[\d+\])*)/g;

/** "chassis (green box)", "box_1 (green)", "revolute chassis - wheel", "floor (red)". Of what is not there, the path.
 * @param {Level} document @param {string} path */
export function nameOf(document, path) {
  const found = parsePath(path);
  const element = elementAt(document, path);
  if (!found || !element) return path;
  if (found.part === "joints") return `${element.type} ${element.a} - ${element.b}`;
  if (found.part === "thrusters") return `thruster of ${element.shape}`;
  const id = found.part === "walls" ? found.name.replace("_", " ") : String(element.id ?? path);
  const role = element.role && element.role !== "none" ? element.role : "";
  const more = [role, found.part === "walls" ? "" : kindOf(element, id)].filter(Boolean).join(" ");
  return more ? `${id} (${more})` : id;
}

/** "box"; "" where the id says so already. @param {any} shape @param {string} id */
function kindOf({ type, vertices }, id) {
  const kind = type !== "polygon" ? String(type) : vertices?.length === 3 ? "triangle" : "quadrilateral";
  return id.includes(kind) || id.includes(type) ? "" : kind;
}

/** A text of the engine in which elements have their names: "shapes[1].friction" is "friction of box_2 (red)".
 * @param {Level} document @param {string} text */
export function namedText(document, text) {
  return text.replace(PATHS, (_, path, field) => (field ? `${fieldWords(field)} of ${nameOf(document, path)}` : nameOf(document, path)));
}

/** ".vertices[2]" is the panel's "corner 3", ".motor.speed" its "motor speed". @param {string} field */
function fieldWords(field) {
  const corner = /^\.vertices\[(\d+)\]/.exec(field);
  return corner ? `corner ${Number(corner[1]) + 1}` : field.slice(1).replaceAll(/[._]/g, " ");
}
