// Panels next to the picture: fields of the selection and of the level, elements, problems.
import { html, useRef, useState } from "../base/html.js";
import { COMMANDS } from "./commands.js";
import { PARTS, parsePath, elementAt, withElement } from "./document.js";
import { renamed } from "./edits.js";
import { fieldsOf, LEVEL_FIELDS, SHAPE_FIELDS, valueOf, withValue } from "./fields.js";
import { forwardWords, newMotor } from "./motors.js";
import { countsOf, freeWords, isFull, largerSize, sizeThatFits } from "./sizes.js";

/** @typedef {import("./state.js").Editor} Editor */
const ALIGNMENTS = COMMANDS.filter((command) => /^(Align|Distribute)/.test(command.label));
/** @typedef {import("./fields.js").Field} Field */

/** Typed text, held until it is a value; the text of another value takes its place. @param {{ value: any, parse: (text: string) => any, show: (value: any) => string, commit: (value: any) => void, label: string, type?: string, step?: number }} props */
function Typed({ value, parse, show, commit, label, type = "text", step }) {
  const shown = show(value);
  const [text, setText] = useState(shown);
  const over = useRef(shown);
  if (over.current !== shown) {
    // Not in an effect: one comes after the picture, and would take away what was typed meanwhile.
    over.current = shown;
    setText(shown);
  }
  const finish = () => {
    const parsed = parse(text);
    if (parsed === undefined) setText(shown);
    else if (show(parsed) !== shown) commit(parsed);
  };
  return html`<input value=${text} type=${type} step=${step ?? "any"} aria-label=${label} onInput=${(/** @type {any} */ e) => setText(e.target.value)}
    onChange=${finish} onKeyDown=${(/** @type {any} */ e) => e.key === "Enter" && finish()} />`;
}

/** @param {any} value */
const numberText = (value) => (value === undefined ? "" : String(Number(Number(value).toFixed(6))));
/** @param {string} text */
function parseNumber(text) {
  const value = Number(text);
  return text.trim() === "" || !Number.isFinite(value) ? undefined : value;
}

/** @param {{ field: Field, element: any, commit: (value: any) => void }} props */
function FieldInput({ field, element, commit }) {
  const value = valueOf(element, field);
  const label = field.label ?? field.name.replace("motor.", "motor ");
  const title = `${field.name}${field.unit ? `, ${field.unit}` : ""}${field.missing === undefined ? "" : `; ${JSON.stringify(field.missing)} if left out`}${field.help ? `; ${field.help}` : ""}`;
  let input;
  if (field.kind === "choice") {
    const options = field.options ?? [];
    const known = options.includes(String(value ?? ""));
    input = html`<select aria-label=${label} onChange=${(/** @type {any} */ e) => commit(typeof field.missing === "number" ? Number(e.target.value) : e.target.value)}>
      ${(known ? options : [String(value), ...options]).map((option) => html`<option key=${option} value=${option} selected=${option === String(value ?? "")}>${option || "-"}</option>`)}</select>`;
  } else if (field.kind === "flag") {
    input = html`<input type="checkbox" aria-label=${label} checked=${value} onChange=${(/** @type {any} */ e) => commit(e.target.checked)} />`;
  } else if (field.kind === "number") {
    input = html`<${Typed} value=${value} parse=${parseNumber} show=${numberText} commit=${commit} label=${label} type="number" step=${field.step} />`;
  } else if (field.kind === "point") {
    const pair = Array.isArray(value) ? value : [0, 0];
    input = html`<span class="pair">${[0, 1].map((k) => html`<${Typed} key=${k} value=${pair[k]} parse=${parseNumber} show=${numberText}
      commit=${(/** @type {number} */ entry) => commit(k ? [pair[0], entry] : [entry, pair[1]])} label=${`${label} ${k + 1}`} type="number" />`)}</span>`;
  } else if (field.kind === "words") {
    const parse = (/** @type {string} */ text) => text.split(",").map((word) => word.trim()).filter(Boolean);
    input = html`<${Typed} value=${value} parse=${parse} show=${(/** @type {any} */ words) => (Array.isArray(words) ? words.join(", ") : String(words))} commit=${commit} label=${label} />`;
  } else {
    input = html`<${Typed} value=${value} parse=${(/** @type {string} */ text) => text} show=${(/** @type {any} */ entry) => String(entry ?? "")} commit=${commit} label=${label} />`;
  }
  return html`<label class="field" title=${title}><span>${label}${field.unit ? html` <i>${field.unit}</i>` : null}</span>${input}</label>`;
}

/** @param {{ editor: Editor }} props */
export function SelectionPanel({ editor }) {
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
  const commit = (/** @type {Field} */ field, /** @type {any} */ value) => {
    if (found.part === "shapes" && field.name === "id") {
      if (editor.settled.shapes.some((shape) => shape.id === value)) return editor.notify(`there is a shape ${value} already`);
      return editor.commit(renamed(editor.settled, found.index, value));
    }
    // From the level as it is now: the panel is drawn again a picture later.
    const now = elementAt(editor.settled, path);
    if (now !== undefined) editor.commit(withElement(editor.settled, path, withValue(now, field, value)));
  };
  const change = (/** @type {any} */ next) => editor.commit(withElement(editor.settled, path, next));
  return html`<section class="panel" data-panel="selection"><header><h3>${nameOf(document, path)}</h3><span class="help">${path}</span></header>
    <div class="fields">${fieldsOf(found.part, element, bodies).map((field) => html`<${FieldInput} key=${`${path} ${field.name}`} field=${field} element=${element} commit=${(/** @type {any} */ value) => commit(field, value)} />`)}</div>
    ${found.part === "joints" && element.motor ? html`<p class="soft" data-forward>${forwardWords(document, element)}</p>` : null}
    ${found.part === "joints" ? html`<div class="row small"><${JointSwitches} document=${document} joint=${element} change=${change} /></div>` : null}
  </section>`;
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

/** Fields that all selected shapes share. @param {{ editor: Editor }} props */
function ManyPanel({ editor }) {
  const { document, selection } = editor;
  const shapes = selection.filter((path) => path.startsWith("shapes["));
  const first = elementAt(document, shapes[0] ?? "");
  const commit = (/** @type {Field} */ field, /** @type {any} */ value) =>
    editor.commit(shapes.reduce((level, path) => withElement(level, path, withValue(elementAt(level, path), field, value)), editor.settled));
  return html`<section class="panel" data-panel="selection"><header><h3>${selection.length} elements</h3><span class="help">fields are set for all ${shapes.length} shapes</span></header>
    <div class="row small">${ALIGNMENTS.map((command) => html`<button key=${command.label} title=${command.keys[0]} onClick=${() => command.run(editor, command.keys[0])}>${command.label.toLowerCase()}</button>`)}</div>
    ${first ? html`<div class="fields">${SHAPE_FIELDS.map((field) => html`<${FieldInput} key=${field.name} field=${field} element=${first} commit=${(/** @type {any} */ value) => commit(field, value)} />`)}</div>` : null}
  </section>`;
}

/** @param {{ editor: Editor }} props */
export function LevelPanel({ editor }) {
  const { document } = editor;
  const { sizes } = editor.engine;
  return html`<section class="panel" data-panel="level"><header><h3>Level</h3></header>
    <div class="fields">${LEVEL_FIELDS.map((field) => html`<${FieldInput} key=${field.name} field=${field} element=${document} commit=${(/** @type {any} */ value) => editor.commit(withValue(editor.settled, field, value))} />`)}</div>
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

/** @param {import("./document.js").Level} document @param {string} path */
function nameOf(document, path) {
  const found = parsePath(path);
  const element = elementAt(document, path);
  if (!found || !element) return path;
  if (found.part === "walls") return `${found.name.replace("_", " ")}${element.role && element.role !== "none" ? ` (${element.role})` : ""}`;
  if (found.part === "shapes") return `${element.id ?? path}${element.role && element.role !== "none" ? ` (${element.role})` : ""}`;
  return found.part === "joints" ? `${element.type} ${element.a} - ${element.b}` : `thruster ${element.shape}`;
}

/** Complaints of the validator and warnings; each leads to what it is about. What a level has not yet is no complaint.
 * @param {{ editor: Editor, checked: import("./checks.js").Checked }} props */
export function ProblemsPanel({ editor, checked }) {
  const { warnings } = checked;
  const problems = checked.problems.filter((problem) => !problem.missing_role);
  const missing = checked.problems.flatMap((problem) => problem.missing_role ?? []);
  const count = checked.numProblems - missing.length;
  const plural = (/** @type {number} */ number, /** @type {string} */ word) => `${number} ${word}${number > 1 ? "s" : ""}`;
  const title = checked.error ? "Not checked" : count ? plural(count, "problem") : missing.length ? "Still to draw" : warnings.length ? `Valid, ${plural(warnings.length, "warning")}` : "Valid";
  const sign = count ? "✗" : !checked.isCurrent || checked.error ? "…" : missing.length ? "✎" : "✓";
  return html`<section class="panel" data-panel="problems" aria-live="polite" data-checked=${checked.isCurrent}><header><h3 class=${count ? "bad" : ""}>${sign} ${checked.isCurrent ? title : "checking ..."}</h3></header>
    ${checked.error ? html`<p class="missing">${checked.error}</p>` : null}
    <div class="elements column">
      ${problems.map((problem, k) => html`<button key=${k} class="problem" onClick=${() => editor.show(problem.path)}><b>${problem.path}</b> ${problem.problem}; ${problem.remedy}</button>`)}
      <${SizeFix} editor=${editor} size=${sizeThatFits(editor.engine.sizes, editor.document)} />
      ${warnings.map((warning, k) => html`<button key=${k} class="warning" onClick=${() => editor.select(warning.paths)}>⚠ ${warning.text}</button>`)}
    </div>
    ${missing.length ? html`<${Guidance} document=${editor.document} missing=${missing} />` : null}
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
