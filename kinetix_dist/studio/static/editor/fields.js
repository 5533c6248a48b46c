// Every field of the level format (docs/level_format.md): where it is, what kind of value it has, what holds if it is left out.

/**
 * @typedef {{ name: string, label?: string, kind: "text" | "number" | "point" | "choice" | "flag" | "words", unit?: string, options?: string[],
 *   missing?: any, required?: boolean, step?: number, low?: number, help?: string }} Field
 *   name: "motor.speed" is one within another; missing: what holds if it is left out
 */

export const ROLES = ["none", "green", "blue", "red"];

/** @type {Field[]} */
const SURFACE = [
  { name: "role", kind: "choice", options: ROLES, missing: "none" },
  { name: "friction", kind: "number", missing: 1, low: 0 },
  { name: "restitution", kind: "number", missing: 0, low: 0 },
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

/** @type {Field[]} what shapes of all types have */
export const SHAPE_FIELDS = [
  ...SURFACE.slice(0, 1),
  { name: "fixed", kind: "flag", missing: false },
  { name: "density", kind: "number", unit: "kg/m²", missing: 1, low: 0 },
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

/** @type {Field[]} */
const MOTOR = [
  { name: "motor.speed", kind: "number", missing: 1, step: 0.1, help: "forward turns b counter-clockwise against a, with a negative speed clockwise: a wheel that is b rolls to the right where it is negative; 1 is 6 rad/s, of a slider 2 m/s" },
  { name: "motor.power", kind: "number", missing: 1, low: 0, step: 0.1 },
  { name: "motor.colour", kind: "choice", options: ["0", "1", "2", "3"], missing: 0 },
  { name: "motor.auto", kind: "flag", missing: false },
  { name: "motor.on", kind: "flag", missing: true },
];

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
      { name: "power", kind: "number", missing: 1, low: 0, step: 0.1 },
      { name: "colour", kind: "choice", options: ["0", "1"], missing: 0 },
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
    ...(element.motor ? MOTOR : []),
  ];
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
