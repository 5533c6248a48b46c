// The tool bar: what draws, roles of the selection and the pin, ready-made mechanisms, commands. On a phone two rows.
import { html } from "../base/html.js";
import { COMMANDS } from "./commands.js";
import { elementAt } from "./document.js";
import { isFixed } from "./fields.js";
import { Icon } from "./icons.js";
import { addMechanism } from "./mechanisms.js";
import { TOOLS } from "./tools.js";

/** @typedef {import("./state.js").Editor} Editor */
const PIN = COMMANDS.find((command) => command.icon === "pin");

const LETTERS = { green: "G", blue: "B", red: "R", none: "–" };

/** @param {{ editor: Editor, isOff: boolean }} props isOff: a level is played */
export function ToolBar({ editor, isOff }) {
  return html`<div class="bar tools" role="toolbar" aria-label="tools">
    <div class="group" role="group" aria-label="draw">${Object.entries(TOOLS).map(([name, tool]) => html`<button key=${name} aria-pressed=${editor.tool === name} aria-label=${tool.label}
      title=${`${tool.label} (${tool.key.toUpperCase()}): ${tool.help}`} disabled=${isOff} onClick=${() => editor.use(name)}><${Icon} name=${name} /><small>${tool.key}</small></button>`)}</div>
    <div class="rest">
      <${Roles} editor=${editor} isOff=${isOff} />
      <${Commands} editor=${editor} isOff=${isOff} />
      <div class="group" role="group" aria-label="mechanisms">${editor.engine.mechanisms.map((/** @type {{ name: string, help: string }} */ { name, help }) => html`<button key=${name} class="mechanism" aria-label=${`Mechanism: ${name}`}
        title=${`${name}: ${help}; put at a free spot`} disabled=${isOff} onClick=${() => addMechanism(editor, name)}><${Icon} name=${name} /><span>${name}</span></button>`)}</div>
    </div>
  </div>`;
}

/** Roles of the selected shapes and walls, and whether they are fixed. @param {{ editor: Editor, isOff: boolean }} props */
function Roles({ editor, isOff }) {
  const holders = editor.selection.filter((path) => /^(shapes|walls)/.test(path));
  const shapes = holders.filter((path) => path.startsWith("shapes"));
  const roles = new Set(holders.map((path) => elementAt(editor.document, path)?.role ?? "none"));
  return html`<div class="group roles" role="group" aria-label="role of the selection">${COMMANDS.filter((command) => command.role).map((command) => html`<button key=${command.role} class="role ${command.role}"
    aria-label=${command.label} aria-pressed=${roles.size === 1 && roles.has(command.role)} title=${`${command.label} (${command.keys[0]}): ${roleHelp(command.role ?? "")}`}
    disabled=${isOff || !holders.length} onClick=${() => command.run(editor, command.keys[0])}>${LETTERS[/** @type {keyof typeof LETTERS} */ (command.role)]}</button>`)}
    <${CommandButton} command=${PIN} isPressed=${shapes.length > 0 && shapes.every((path) => isFixed(elementAt(editor.document, path)))} isOff=${isOff || !shapes.length} editor=${editor} /></div>`;
}

/** @param {string} role */
const roleHelp = (role) => ({ green: "it has to touch blue", blue: "the goal of green", red: "green must not touch it" })[role] ?? "of no meaning for the goal";

/** isPressed: null where the button has no state. @param {{ command: import("./commands.js").Command, isPressed: boolean | null, isOff: boolean, editor: Editor }} props */
const CommandButton = ({ command, isPressed, isOff, editor }) => html`<button aria-label=${command.label} title=${`${command.label} (${command.keys[0]})`}
  aria-pressed=${isPressed} disabled=${isOff} onClick=${() => command.run(editor, command.keys[0])}><${Icon} name=${command.icon} /></button>`;

/** @param {{ editor: Editor, isOff: boolean }} props */
function Commands({ editor, isOff }) {
  const add = () => {
    editor.adds = !editor.adds;
    editor.changed();
  };
  return html`<div class="group" role="group" aria-label="commands">${COMMANDS.filter((command) => command.icon && command !== PIN).map((command) => html`<${CommandButton} key=${command.label} command=${command}
      isPressed=${command.icon === "snap" ? editor.snaps : null} isOff=${isOff} editor=${editor} />`)}
    <button aria-pressed=${editor.adds} title="Add to the selection with each click (as shift)" aria-label="Add to the selection" disabled=${isOff} onClick=${add}><${Icon} name="add" /></button></div>`;
}
