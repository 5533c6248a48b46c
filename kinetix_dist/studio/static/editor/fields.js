// Every field of the level format (docs/level_format.md): where it is, what kind of value it has, what holds if it is left out.

/**
 * @typedef {{ name: string, label?: string, kind: "text" | "number" | "point" | "choice" | "flag" | "words", unit?: string, options?: string[],
 *   missing?: any, required?: boolean, step?: number, low?: number, usual?: [number, number], help?: string }} Field
 *   name: "motor.speed" is one within another; missing: what holds if it is left out; usual: what drawn and random levels have
 */

export const ROLES = ["none", "green", "blue", "red"];

/** @type {Field[]} */
const SURFACE = [
  { name: "role", kind: "choice", options: ROLES, missing: "none" },
  { name: "friction", kind: "number", missing: 1, low: 0, usual: [0.1, 1.2], help: "the product of the two shapes' counts" },
  { name: "restitution", kind: "number", missing: 0, low: 0, usual: [0, 0.9], help: "share of the speed after a bounce, 1 at most" },
];

/** @type {Field[]} */
export const LEVEL_FIELDS = [
  { name: "name", kind: "text", required: true },
  { name: "size", kind: "choice", options: ["s", "m", "l"], required: true },
  { name: "title", kind: "text", missing: "" },
  { name: "description", kind: "text", missing: "" },
  { name: "source", kind: "text", missing: "" },
  { name: "tags", kind: "words", missing: [] },
  { name: "difficulty", kind: "choice", options: ["", "easy", "medium", "hard"], missing: "" },
  { name: "gravity", kind: "point", unit: "m/s²", missing: [0, -9.81] },
];

/** @type {Field} */
export const FIXED = { name: "fixed", kind: "flag", missing: false, help: "it never moves" };
/** @param {any} shape */
export const isFixed = (shape) => valueOf(shape, FIXED) === true;

/** @type {Field[]} what shapes of all types have */
const SHAPE_FIELDS = [
  ...SURFACE.slice(0, 1),
  FIXED,
  { name: "density", kind: "number", unit: "kg/m²", missing: 1, low: 0, usual: [0.5, 4] },
  ...SURFACE.slice(1),
  { name: "collision", kind: "choice", options: ["normal", "ghost", "all"], missing: "normal" },
  { name: "velocity", kind: "point", unit: "m/s", missing: [0, 0] },
  { name: "angular_velocity", label: "angular velocity", kind: "number", unit: "rad/s", missing: 0 },
];

/** @type {Record<string, Field[]>} what only shapes of a type have */
const OF_TYPE = {
  box: [{ name: "width", kind: "number", unit: "m", required: true, low: 0 }, { name: "height", kind: "number", unit: "m", required: true, low: 0 }],
  circle: [{ name: "radius", kind: "number", unit: "m", required: true, low: 0 }],
  polygon: [0, 1, 2, 3].map((k) => ({ name: `vertices.${k}`, label: `corner ${k + 1}`, kind: "point", unit: "m", required: true })),
};

/** Speed and power are shares of the engine's (docs/level_format.md). @param {boolean} isSlider @returns {Field[]} */
const motorFields = (isSlider) => [
  { name: "motor.speed", kind: "number", unit: isSlider ? "×2 m/s" : "×6 rad/s", missing: 1, step: 0.1, usual: [0.4, 3], help: isSlider ? "forward pushes b along the axis, with a negative speed against it" : "forward turns b counter-clockwise against a, with a negative speed clockwise: a wheel that is b rolls to the right where it is negative" },
  { name: "motor.power", kind: "number", unit: isSlider ? "×100 m/s²" : "×900 rad/s²", missing: 1, low: 0, step: 0.1, usual: [0.1, 3], help: "most acceleration of its two shapes alone: what they carry needs more" },
  { name: "motor.colour", kind: "choice", options: ["0", "1", "2", "3"], missing: 0, help: "the action, and the keys, that drive it" },
  { name: "motor.auto", kind: "flag", missing: false, help: "it always runs forward, without an action" },
  { name: "motor.on", kind: "flag", missing: true },
];

/** What each element has for itself, and what depends on it. */
const OWN = new Set(["id", "position", "type", "a", "b", "shape", "anchor", "anchor_a", "anchor_b"]);

/** Fields of one element. @param {string} part @param {any} element @param {string[]} bodies names of shapes and walls @returns {Field[]} */
export function fieldsOf(part, element, bodies) {
  if (part === "walls") return SURFACE;
  if (part === "shapes") {
    const own = (OF_TYPE[element.type] ?? []).filter((field) => !field.name.startsWith("vertices.") || element.vertices?.[Number(field.name.slice(9))]);
    return [
      { name: "id", kind: "text", required: true },
      { name: "position", kind: "point", unit: "m", required: true },
      { name: "angle", kind: "number", unit: "rad", missing: 0 },
      ...own,
      ...SHAPE_FIELDS,
    ];
  }
  if (part === "thrusters") {
    return [
      { name: "shape", kind: "choice", options: bodies, required: true },
      element.anchor ? { name: "anchor", label: "anchor (world)", kind: "point", unit: "m", required: true } : { name: "position", label: "position (on the shape)", kind: "point", unit: "m", missing: [0, 0] },
      { name: "angle", kind: "number", unit: "rad", required: true },
      { name: "power", kind: "number", unit: "×10 N", missing: 1, low: 0, step: 0.1, usual: [0.04, 1] },
      { name: "colour", kind: "choice", options: ["0", "1"], missing: 0, help: "the action, and the key, that drive it" },
    ];
  }
  /** @type {Field[]} */
  const ends = element.anchor
    ? [{ name: "anchor", label: "anchor (world)", kind: "point", unit: "m", required: true }]
    : ["a", "b"].map((end) => ({ name: `anchor_${end}`, label: `anchor on ${end}`, kind: "point", unit: "m", required: true }));
  return [
    { name: "type", kind: "choice", options: ["revolute", "fixed", "prismatic"], required: true },
    { name: "a", kind: "choice", options: bodies, required: true },
    { name: "b", kind: "choice", options: bodies, required: true },
    ...ends,
    { name: "rest_angle", label: "rest angle", kind: "number", unit: "rad" },
    ...(element.type === "prismatic" ? [/** @type {Field} */ ({ name: "axis", kind: "number", unit: "rad", required: true })] : []),
    ...(element.limits ? [/** @type {Field} */ ({ name: "limits", kind: "point", unit: element.type === "prismatic" ? "m" : "rad", required: true })] : []),
    ...(element.motor ? motorFields(element.type === "prismatic") : []),
  ];
}

/** Fields that several elements of one part share. @param {string} part @param {any[]} elements @returns {Field[]} */
export function sharedFields(part, elements) {
  const [first, ...others] = elements.map((element) => fieldsOf(part, element, []));
  const isShared = (/** @type {Field} */ field) => others.every((fields) => fields.some((other) => other.name === field.name && other.unit === field.unit));
  return first.filter((field) => !OWN.has(field.name) && !field.name.startsWith("vertices.") && isShared(field));
}

/** @param {any} element @param {Field} field */
export function valueOf(element, field) {
  return field.name.split(".").reduce((value, key) => value?.[key], element) ?? field.missing;
}

/** The element with another value of a field; one that holds anyhow is left out. @param {any} element @param {Field} field @param {any} value @returns {any} */
export function withValue(element, field, value) {
  const [key, ...rest] = field.name.split(".");
  const isMissing = value === undefined || (!field.required && JSON.stringify(value) === JSON.stringify(field.missing));
  if (rest.length) {
    const inner = withValue(element[key] ?? {}, { ...field, name: rest.join(".") }, value);
    return { ...element, [key]: Array.isArray(element[key]) ? Object.values(inner) : inner };
  }
  const changed = { ...element, [key]: value };
  if (isMissing) delete changed[key];
  return changed;
}
