// Panels next to the picture: fields of the selection and of the level, elements, problems.
import { html, useRef, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { COMMANDS, giveRole } from "./commands.js";
import { PARTS, parsePath, elementAt, withElement } from "./document.js";
import { joined, renamed } from "./edits.js";
import { fieldsOf, LEVEL_FIELDS, sharedFields, valueOf, withValue } from "./fields.js";
import { forwardWords, newMotor } from "./motors.js";
import { namedText, nameOf } from "./names.js";
import { countsOf, freeWords, isFull, largerSize, sizeThatFits } from "./sizes.js";

/** @typedef {import("./state.js").Editor} Editor */
const ALIGNMENTS = COMMANDS.filter((command) => /^(Align|Distribute)/.test(command.label));
const PARTS_OF_PANEL = [...PARTS, "walls"];
const THRUST_N = 10; // of power 1
const GRAVITY = [0, -9.81]; // m/s², of a level that names none
/** @typedef {import("./fields.js").Field} Field */

/** Several values in one field, of which only what is typed or chosen is written. */
const MIXED = "mixed";

/** Typed text, held until it is a value; the text of another value takes its place. @param {{ value: any, isMixed: boolean, parse: (text: string) => any, show: (value: any) => string, commit: (value: any) => any, label: string, type?: string, step?: number }} props */
function Typed({ value, isMixed, parse, show, commit, label, type = "text", step }) {
  const shown = isMixed ? "" : show(value);
  const [text, setText] = useState(shown);
  const over = useRef(shown);
  if (over.current !== shown) {
    // Not in an effect: one comes after the picture, and would take away what was typed meanwhile.
    over.current = shown;
    setText(shown);
  }
  const finish = () => {
    if (text === shown) return; // nothing was typed
    const parsed = parse(text);
    if (parsed === undefined) setText(shown);
    else if (show(parsed) !== shown && commit(parsed) === false) setText(shown);
  };
  return html`<input value=${text} type=${type} step=${step ?? "any"} aria-label=${label} placeholder=${isMixed ? MIXED : ""} onInput=${(/** @type {any} */ e) => setText(e.target.value)}
    onChange=${finish} onKeyDown=${(/** @type {any} */ e) => e.key === "Enter" && finish()} />`;
}

/** @param {any} value */
const numberText = (value) => (value === undefined ? "" : String(Number(Number(value).toFixed(6))));
/** @param {string} text */
function parseNumber(text) {
  const value = Number(text);
  return text.trim() === "" || !Number.isFinite(value) ? undefined : value;
}

/** One field of an element, or of several. `commit` gets what becomes of the value that each of them has.
 * @param {{ field: Field, elements: any[], commit: (change: (value: any) => any) => any }} props commit: false where it was refused */
function FieldInput({ field, elements, commit }) {
  const values = elements.map((element) => valueOf(element, field));
  const [value] = values;
  const differ = (/** @type {(value: any) => any} */ part) => values.some((other) => JSON.stringify(part(other)) !== JSON.stringify(part(value)));
  const isMixed = differ((entry) => entry);
  const label = field.label ?? field.name.replace("motor.", "motor ");
  const set = (/** @type {any} */ entry) => commit(() => entry);
  let input;
  if (field.kind === "choice") {
    const options = field.options ?? [];
    const now = isMixed ? MIXED : String(value ?? "");
    input = html`<select aria-label=${label} value=${now} onChange=${(/** @type {any} */ e) => set(typeof field.missing === "number" ? Number(e.target.value) : e.target.value)}>
      ${(options.includes(now) ? options : [now, ...options]).map((option) => html`<option key=${option} value=${option} disabled=${option === MIXED}>${option || "-"}</option>`)}</select>`;
  } else if (field.kind === "flag") {
    input = html`<span><input type="checkbox" aria-label=${label} checked=${!isMixed && value} indeterminate=${isMixed} onChange=${(/** @type {any} */ e) => set(e.target.checked)} />${isMixed ? html` <i>${MIXED}</i>` : null}</span>`;
  } else if (field.kind === "number") {
    input = html`<${Typed} value=${value} isMixed=${isMixed} parse=${parseNumber} show=${numberText} commit=${set} label=${label} type="number" step=${field.step} />`;
  } else if (field.kind === "point") {
    const pairOf = (/** @type {any} */ entry) => (Array.isArray(entry) ? entry : [0, 0]);
    input = html`<span class="pair">${[0, 1].map((k) => html`<${Typed} key=${k} value=${pairOf(value)[k]} isMixed=${differ((entry) => pairOf(entry)[k])} parse=${parseNumber} show=${numberText}
      commit=${(/** @type {number} */ entry) => commit((pair) => pairOf(pair).with(k, entry))} label=${`${label} ${k + 1}`} type="number" />`)}</span>`;
  } else if (field.kind === "words") {
    const parse = (/** @type {string} */ text) => text.split(",").map((word) => word.trim()).filter(Boolean);
    input = html`<${Typed} value=${value} isMixed=${isMixed} parse=${parse} show=${(/** @type {any} */ words) => (Array.isArray(words) ? words.join(", ") : String(words))} commit=${set} label=${label} />`;
  } else {
    input = html`<${Typed} value=${value} isMixed=${isMixed} parse=${(/** @type {string} */ text) => text} show=${(/** @type {any} */ entry) => String(entry ?? "")} commit=${set} label=${label} />`;
  }
  return html`<label class="field" title=${titleOf(field)}><span>${label}${field.unit ? html` <i>${field.unit}</i>` : null}</span>${input}</label>`;
}

/** "motor.power, ×900 rad/s²; usual 0.1 to 3; 1 if left out; ..." @param {Field} field */
function titleOf({ name, unit, usual, missing, help }) {
  return [`${name}${unit ? `, ${unit}` : ""}`, usual && `usual ${usual[0]} to ${usual[1]}`, missing !== undefined && `${JSON.stringify(missing)} if left out`, help].filter(Boolean).join("; ");
}

/** @param {{ editor: Editor, facts: any }} props facts: of the engine, null where the level has problems */
export function SelectionPanel({ editor, facts }) {
  const { document, selection } = editor;
  if (!selection.length) {
    return html`<section class="panel" data-panel="selection"><header><h3>Nothing is selected</h3></header>
      <p class="soft">Click a shape, joint, thruster or wall; Tab goes through all.</p></section>`;
  }
  if (selection.length > 1) return html`<${ManyPanel} editor=${editor} />`;
  const [path] = selection;
  const found = parsePath(path);
  const element = elementAt(document, path);
  if (!found || !element) return null;
  const bodies = [...document.shapes.map((shape) => shape.id), ...(found.part === "joints" ? editor.walls.map((wall) => wall.name) : [])];
  const change = (/** @type {any} */ next) => editor.commit(withElement(editor.settled, path, next));
  return html`<section class="panel" data-panel="selection"><header><h3>${nameOf(document, path)}</h3><span class="help">${path}</span></header>
    <div class="fields">${fieldsOf(found.part, element, bodies).map((field) => html`<${FieldInput} key=${`${path} ${field.name}`} field=${field} elements=${[element]} commit=${(/** @type {any} */ change) => write(editor, [path], field, change)} />`)}</div>
    ${found.part === "joints" && element.motor ? html`<p class="soft" data-forward>${forwardWords(document, element)}</p>` : null}
    ${found.part === "joints" ? html`<div class="row small"><${JointSwitches} document=${document} joint=${element} change=${change} /></div>` : null}
    ${found.part === "thrusters" ? html`<p class="soft" data-push>${pushWords(document, element, facts)}</p>` : null}
  </section>`;
}

/** Changes a field of elements, as one step. Roles and names are of one shape: what has them besides changes too.
 * @param {Editor} editor @param {readonly string[]} paths @param {Field} field @param {(value: any) => any} change */
function write(editor, paths, field, change) {
  // From the level as it is now: the panel is drawn again a picture later.
  const there = paths.filter((path) => elementAt(editor.settled, path) !== undefined);
  if (field.name === "role") return giveRole(editor, there, change(undefined));
  if (field.name === "id") return rename(editor, there[0], change(undefined));
  return editor.commit(there.reduce((level, path) => {
    const element = elementAt(level, path);
    return withElement(level, path, withValue(element, field, change(valueOf(element, field))));
  }, editor.settled));
}

/** @param {Editor} editor @param {string} path @param {string} id @returns {boolean} whether the name was free */
function rename(editor, path, id) {
  const found = parsePath(path);
  if (found?.part !== "shapes") return false;
  if (editor.settled.shapes.some((shape) => shape.id === id)) {
    editor.notify(`there is a shape ${id} already`);
    return false;
  }
  editor.commit(renamed(editor.settled, found.index, id));
  return true;
}

/** Thrust beside the weight that it would have to lift. @param {import("./document.js").Level} document @param {any} thruster @param {any} facts */
function pushWords(document, thruster, facts) {
  const push = `It pushes with up to ${numberText(Number(((thruster.power ?? 1) * THRUST_N).toPrecision(3)))} N`;
  const own = document.shapes.findIndex((shape) => shape.id === thruster.shape);
  const body = joined(document, [`shapes[${own}]`]);
  const masses = body.map((path) => facts?.masses[path]);
  if (!body.length || masses.some((mass) => !mass)) return `${push}.`; // something fixed, or not known yet
  const weight = masses.reduce((sum, mass) => sum + mass, 0) * Math.hypot(...(document.gravity ?? GRAVITY));
  return `${push}; ${thruster.shape}${body.length > 1 ? " and what is joined to it weigh" : " weighs"} ${weight.toPrecision(2)} N.`;
}

/** Motor and limits are there or not. @param {{ document: import("./document.js").Level, joint: any, change: (joint: any) => void }} props */
function JointSwitches({ document, joint, change }) {
  const switched = (/** @type {string} */ name, /** @type {any} */ value) => {
    const next = { ...joint, [name]: value };
    if (joint[name]) delete next[name];
    change(next);
  };
  const limits = joint.type === "prismatic" ? [-0.5, 0.5] : [-0.785398, 0.785398];
  return html`<button aria-pressed=${Boolean(joint.motor)} onClick=${() => switched("motor", newMotor(document, joint))}>motor</button>
    ${joint.type === "fixed" ? null : html`<button aria-pressed=${Boolean(joint.limits)} onClick=${() => switched("limits", limits)}>limits</button>`}`;
}

/** Fields that the selected elements share: those of the shapes, if there are some. @param {{ editor: Editor }} props */
function ManyPanel({ editor }) {
  const { document, selection } = editor;
  const part = PARTS_OF_PANEL.find((name) => selection.some((path) => path.startsWith(name))) ?? "shapes";
  const paths = selection.filter((path) => path.startsWith(part));
  const elements = paths.map((path) => elementAt(document, path));
  return html`<section class="panel" data-panel="selection"><header><h3>${selection.length} elements</h3><span class="help">fields of ${count(paths.length, part.slice(0, -1))}</span></header>
    <div class="row small">${ALIGNMENTS.map((command) => html`<button key=${command.label} title=${command.keys[0]} onClick=${() => command.run(editor, command.keys[0])}>${command.label.toLowerCase()}</button>`)}</div>
    <div class="fields">${sharedFields(part, elements).map((field) => html`<${FieldInput} key=${`${paths.join()} ${field.name}`} field=${field} elements=${elements} commit=${(/** @type {any} */ change) => write(editor, paths, field, change)} />`)}</div>
  </section>`;
}

/** @param {{ editor: Editor }} props */
export function LevelPanel({ editor }) {
  const { document } = editor;
  const { sizes } = editor.engine;
  return html`<section class="panel" data-panel="level"><header><h3>Level</h3></header>
    <div class="fields">${LEVEL_FIELDS.map((field) => html`<${FieldInput} key=${field.name} field=${field} elements=${[document]} commit=${(/** @type {any} */ change) => editor.commit(withValue(editor.settled, field, change(valueOf(editor.settled, field))))} />`)}</div>
    <p class="soft">space for ${freeWords(sizes, document)} more ${isFull(sizes, document) ? html`<${SizeFix} editor=${editor} size=${largerSize(sizes, document.size, countsOf(document))} />` : null}</p>
  </section>`;
}

/** Elements as buttons, for the keyboard and for those that are hard to hit. @param {{ editor: Editor, facts: any }} props */
export function ThingsPanel({ editor, facts }) {
  const paths = [
    ...PARTS.flatMap((part) => (editor.document[part] ?? []).map((/** @type {any} */ _, /** @type {number} */ k) => `${part}[${k}]`)),
    ...editor.walls.map((wall) => `walls.${wall.name}`),
  ];
  return html`<section class="panel" data-panel="elements"><header><h3>Elements</h3><span class="help">mass in kg</span></header>
    <div class="elements">${paths.map((path) => html`<button key=${path} aria-pressed=${editor.selection.includes(path)}
      onClick=${(/** @type {MouseEvent} */ e) => editor.select(e.shiftKey || editor.adds ? [...editor.selection, path] : [path])}>${nameOf(editor.document, path)}${facts?.masses[path] ? html` <i>${facts.masses[path].toPrecision(2)}</i>` : null}</button>`)}</div>
  </section>`;
}

/** Complaints of the validator and warnings; each leads to what it is about. What a level has not yet is no complaint.
 * @param {{ editor: Editor, checked: import("./checks.js").Checked }} props */
export function ProblemsPanel({ editor, checked }) {
  const { document } = editor;
  const { warnings } = checked;
  const problems = checked.problems.filter((problem) => !problem.missing_role);
  const missing = checked.problems.flatMap((problem) => problem.missing_role ?? []);
  const numProblems = checked.numProblems - missing.length;
  const title = checked.error ? "Not checked" : numProblems ? count(numProblems, "problem") : missing.length ? "Still to draw" : warnings.length ? `Valid, ${count(warnings.length, "warning")}` : "Valid";
  const sign = numProblems ? "✗" : !checked.isCurrent || checked.error ? "…" : missing.length ? "✎" : "✓";
  return html`<section class="panel" data-panel="problems" aria-live="polite" data-checked=${checked.isCurrent}><header><h3 class=${numProblems ? "bad" : ""}>${sign} ${checked.isCurrent ? title : "checking ..."}</h3></header>
    ${checked.error ? html`<p class="missing">${checked.error}</p>` : null}
    <div class="elements column">
      ${problems.map((problem, k) => html`<button key=${k} class="problem" title="select it" onClick=${() => editor.show(problem.paths)}><b>${problem.paths.map((path) => namedText(document, path)).join(" and ")}</b>${problem.path ? ": " : ""}${namedText(document, problem.problem)}; ${namedText(document, problem.remedy)}</button>`)}
      <${SizeFix} editor=${editor} size=${sizeThatFits(editor.engine.sizes, document)} />
      ${warnings.map((warning, k) => html`<button key=${k} class="warning" title=${warning.paths.length ? "select it" : "of the level as a whole"} onClick=${() => editor.show(warning.paths)}>⚠ ${namedText(document, warning.text)}</button>`)}
    </div>
    ${missing.length ? html`<${Guidance} document=${document} missing=${missing} />` : null}
  </section>`;
}

/** What a level needs before it can be played. @param {{ document: import("./document.js").Level, missing: string[] }} props */
function Guidance({ document, missing }) {
  const isDriven = document.joints?.some((joint) => joint.motor) || document.thrusters?.length;
  const steps = missing.map((role) => `a ${role} shape: draw one, or select one and press ${role === "green" ? "G" : "B"} in the tool bar`);
  if (!isDriven) steps.push("something to control: a joint with a motor, a thruster, or a ready-made mechanism");
  return html`<div class="soft" data-guidance><p>Green has to touch blue, and never red. This level needs</p><ul>${steps.map((step) => html`<li key=${step}>${step}</li>`)}</ul></div>`;
}

/** A larger size, as a step that can be undone. @param {{ editor: Editor, size: string | null }} props */
function SizeFix({ editor, size }) {
  if (size === null) return null;
  return html`<button class="remedy" onClick=${() => editor.commit({ ...editor.settled, size })}>use size ${size.toUpperCase()}</button>`;
}
