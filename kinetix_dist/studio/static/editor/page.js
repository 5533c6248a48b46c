// The editor: bar of tools, picture, panels. #/edit; #/edit?level=... has a level in it, #/edit?from=api/... leads to one.
import { readAddress, setQuery, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { useConnection } from "../base/channel.js";
import { html, useEffect, useMemo, useRef, useState } from "../base/html.js";
import { useListeners } from "../base/listeners.js";
import { AttemptsPanel } from "../play/attempts.js";
import { PLAY_KEYS, Play, playKey } from "../play/play.js";
import { PlayBar, PlayerChoice, policyOf } from "../play/play_bar.js";
import { CanvasView } from "./canvas_view.js";
import { Checks } from "./checks.js";
import { COMMANDS, commandOf, keyOf } from "./commands.js";
import { newLevel } from "./document.js";
import { copied } from "./edits.js";
import { downloadLevel, downloadPicture, dropDraft, findDraft, keepDraft, MAX_TEXT, openFile, openStored, openText, readLevel, saveFile } from "./files.js";
import { Gallery, levelOf } from "./gallery.js";
import { levelTextOf, linked, packed } from "./links.js";
import { MakePanel } from "./make_panel.js";
import { LevelPanel, ProblemsPanel, SelectionPanel, ThingsPanel } from "./panels.js";
import { Editor } from "./state.js";
import { TeachPanel } from "./teach_panel.js";
import { ToolBar } from "./tool_bar.js";
import { TOOLS } from "./tools.js";

export function EditorPage() {
  const engine = useRequest(() => get("engine"), []);
  const about = useRequest(() => get("levels"), []);
  const problem = engine.error ?? about.error;
  if (problem) return html`<main><p class="missing" role="alert">The editor needs the engine: ${problem}</p></main>`;
  if (!engine.data || !about.data) return html`<main><p class="soft" role="status">the engine starts, some seconds ...</p></main>`;
  return html`<${Opening} engine=${engine.data} about=${about.data} />`;
}

/** Waits for the first level: one that came later would replace what a person has made by then.
 * @param {{ engine: import("../world/display_list.js").Engine, about: any }} props */
function Opening({ engine, about }) {
  const editor = useMemo(() => new Editor(engine), [engine]);
  const [opened, setOpened] = useState(/** @type {Opened | null} */ (null));
  useEffect(() => void begin(editor, about).then(setOpened), [editor]);
  if (!opened) return html`<main><p class="soft" role="status">the level is opened ...</p></main>`;
  return html`<${Workplace} editor=${editor} opened=${opened} engine=${engine} about=${about} />`;
}

/** @param {{ editor: Editor, opened: Opened, engine: import("../world/display_list.js").Engine, about: any }} props */
function Workplace({ editor, opened, engine, about }) {
  const { play, checks } = useMemo(() => {
    const changed = () => editor.changed();
    return { play: new Play(changed), checks: new Checks(changed) };
  }, [editor]);
  const [panel, setPanel] = useState(opened.panel);
  const [policy, setPolicy] = useState(about.plays ?? "keys");
  const [conflict, setConflict] = useState(/** @type {import("./files.js").Conflict | null} */ (null));
  const [draft, setDraft] = useState(findDraft);
  const [isDropping, setDropping] = useState(false);
  const connection = useConnection();
  const drafted = useRef(/** @type {any} */ (null));
  useListeners(editor.listeners);
  document.title = `${editor.document.name} · editor`;

  const [isToPlay, setToPlay] = useState(opened.isNamed && Boolean(about.plays)); // that of `levels play`
  useEffect(() => {
    if (!isToPlay || connection !== "connected") return;
    setToPlay(false);
    void start();
  }, [isToPlay, connection]);
  useEffect(() => {
    if (connection === "connected") checks.request(editor.settled);
  }, [editor.settled, connection]);
  useEffect(() => {
    if (play.problem && !play.isOpen) void play.close(); // it was about the level before
  }, [editor.settled]);
  useEffect(() => {
    if (drafted.current === editor.history.present) return undefined;
    drafted.current = editor.history.present;
    const timer = setTimeout(() => keepDraft(editor), 300);
    return () => clearTimeout(timer);
  }, [editor.history.present]);
  useEffect(() => () => {
    checks.end();
    void play.close();
  }, [checks, play]);

  const start = async () => {
    if (play.isOpen) return play.close();
    editor.cancel();
    const { given } = editor;
    await play.open(given, policyOf(policy), { env: "run" in given ? { run: given.run } : undefined });
  };
  useKeys(editor, play, start);
  // A link that is put into the address of this page changes nothing but what is behind #.
  const inAddress = useAddress().query.get("level");
  const shown = useRef(inAddress);
  useEffect(() => {
    if (inAddress === shown.current) return;
    shown.current = inAddress;
    if (inAddress) void open(async () => editor.open(await readLevel(await levelTextOf(inAddress))));
  }, [inAddress]);

  const save = async (/** @type {import("./files.js").Conflict | null} */ over = null) => {
    const name = over?.name ?? editor.file ?? about.files?.only ?? askName(editor);
    if (!name) return;
    setConflict(await saveFile(editor, name, over));
    if (!editor.isUnsaved) dropDraft();
  };
  const open = async (/** @type {() => Promise<void>} */ act) => {
    await play.close();
    try {
      await act();
      setPanel("level");
    } catch (error) {
      editor.notify(error instanceof Error ? error.message : String(error));
    }
  };
  const drop = (/** @type {DragEvent} */ event) => {
    event.preventDefault();
    setDropping(false);
    const file = event.dataTransfer?.files[0];
    const text = event.dataTransfer?.getData("text/plain") ?? "";
    if (!file && text) return void open(() => openText(editor, text));
    if (!file) return;
    if (file.size > MAX_TEXT) return editor.notify(`${file.name} is too large for a level: ${(file.size / 1e6).toFixed(1)} MB; a level has a few kB`);
    void open(async () => openText(editor, await file.text()));
  };
  const link = async () => {
    shown.current = await packed(editor.document);
    setQuery({ level: shown.current, from: null });
    const isCopied = await (navigator.clipboard?.writeText(location.href) ?? Promise.reject()).then(() => true, () => false);
    const where = isCopied ? "the link is copied" : "the link is in the address bar";
    editor.notify(`${where} (${location.href.length} characters); it opens in any installation: paste it into an editor, or kinetix-dist edit 'LINK'`);
  };
  const { facts } = checks.checked;

  return html`<main class="editor ${isDropping ? "dropping" : ""}" onDragOver=${(/** @type {DragEvent} */ e) => { e.preventDefault(); setDropping(true); }} onDragLeave=${() => setDropping(false)} onDrop=${drop}>
    <${ToolBar} editor=${editor} isOff=${play.isOpen} />
    <div class="bar files">
      <button class="primary" onClick=${start} title="Space">${play.isOpen ? "■ stop" : "▶ play"}</button>
      <${PlayerChoice} play=${play} value=${policy} choose=${setPolicy} engine=${engine} />
      <span class="gap"></span>
      ${about.files ? html`<button onClick=${() => save()} title="Ctrl+S">save${editor.isUnsaved ? " •" : ""}</button>` : null}
      <button onClick=${() => downloadLevel(editor, "kinetix-dist")}>download</button>
      <button onClick=${() => downloadLevel(editor, "public")} title="as a file of the public Kinetix package">public format</button>
      <button onClick=${() => downloadPicture(editor)}>PNG</button>
      <button onClick=${link} title="an address with the level in it">link</button>
      <button onClick=${() => open(async () => editor.open(newLevel()))}>new</button>
      <label class="button">open<input type="file" accept=".json" hidden onChange=${(/** @type {any} */ e) => { const [file] = e.target.files; if (file) void open(async () => (file.size > MAX_TEXT ? editor.notify(`${file.name} is too large for a level`) : openText(editor, await file.text()))); e.target.value = ""; }} /></label>
      <span class="soft file">${editor.file ?? (about.files ? "not saved yet" : "")}</span>
    </div>
    ${draft ? html`<div class="notes" role="alert">A level that was not saved is here from ${new Date(draft.at).toLocaleString()}.
      <button onClick=${() => open(async () => { editor.open(await readLevel(draft.text)); setDraft(null); })}>bring it back</button> <button onClick=${() => { dropDraft(); setDraft(null); }}>discard it</button></div>` : null}
    ${conflict ? html`<div class="notes" role="alert">${conflict.problem}.
      <button onClick=${() => save(conflict)}>${conflict.hash === null ? "save it anew" : "save over it"}</button>
      ${conflict.hash === null ? null : html`<button onClick=${() => { setConflict(null); void open(() => openFile(editor, conflict.name)); }}>open what is there</button>`}
      <button onClick=${() => setConflict(null)}>leave it</button></div>` : null}
    <div class="workplace">
      <div class="picture">
        <${CanvasView} editor=${editor} play=${play} />
        ${play.isOpen || play.problem ? html`<${PlayBar} play=${play}><button onClick=${() => play.close()} title="Space or Escape">✎ edit</button></${PlayBar}>` : html`<p class="note" role="status">${editor.note || TOOLS[editor.tool].help}
          ${editor.remedy ? html` <button class="remedy" onClick=${editor.remedy.run}>${editor.remedy.label}</button>` : null}</p>`}
      </div>
      <aside class="side">
        <${ProblemsPanel} editor=${editor} checked=${checks.of(editor.settled)} />
        <div class="row small" role="tablist">${["level", "gallery", "help"].map((name) => html`<button key=${name} role="tab" aria-pressed=${panel === name} onClick=${() => setPanel(name)}>${name}</button>`)}</div>
        ${panel === "gallery" ? html`<${Gallery} about=${about} engine=${engine} openDesigned=${(/** @type {any} */ entry) => open(async () => editor.open(await levelOf(entry)))} openFile=${(/** @type {string} */ name) => open(() => openFile(editor, name))}
          openText=${(/** @type {string} */ text) => open(() => openText(editor, text))} />` : null}
        ${panel === "help" ? html`<${Help} />` : null}
        ${panel === "level" ? html`<${SelectionPanel} editor=${editor} facts=${facts} /><${TeachPanel} editor=${editor} play=${play} /><${AttemptsPanel} given=${editor.given} subject=${editor.document} engine=${engine} player=${policy} /><${ThingsPanel} editor=${editor} facts=${facts} /><${LevelPanel} editor=${editor} /><${MakePanel} editor=${editor} />` : null}
      </aside>
    </div>
  </main>`;
}

/** @typedef {{ panel: string, isNamed: boolean }} Opened isNamed: it is the level of the command line */

/** Opens the level that the address or the command line names. @param {Editor} editor @param {any} about @returns {Promise<Opened>} */
async function begin(editor, about) {
  const { query } = readAddress();
  const [level, from] = [query.get("level"), query.get("from")];
  /** @type {Opened} */
  const opened = { panel: "level", isNamed: false };
  try {
    if (level) editor.open(await readLevel(await levelTextOf(level)));
    else if (from?.startsWith("runs/")) await openStored(editor, from);
    else if (about.opens) {
      if (about.opens.startsWith("file/")) await openNamed(editor, about.opens.slice(5));
      else if (about.opens.startsWith("link/")) editor.open(await readLevel(await levelTextOf(about.opens.slice(5))));
      else await openDesigned(editor, about, about.opens.replace("designed/", ""));
      opened.isNamed = !from;
    } else opened.panel = "gallery";
  } catch (error) {
    editor.notify(`the level cannot be opened: ${error instanceof Error ? error.message : error}`);
  }
  editor.history.past = []; // there is nothing before the first level
  return opened;
}

/** @param {Editor} editor @param {string} name of the file of the command line, which may be new */
async function openNamed(editor, name) {
  const listed = await get("files");
  if (listed.files.some((/** @type {any} */ entry) => entry.name === name)) return openFile(editor, name);
  editor.open({ ...newLevel(), name: name.replace(/\.json$/, "") }, { file: name, hash: null });
  return undefined;
}

/** @param {Editor} editor @param {any} about @param {string} name */
async function openDesigned(editor, about, name) {
  for (const set of about.sets) {
    const { levels } = await get(`levels/sets/${set.name}`);
    const found = levels.find((/** @type {any} */ entry) => entry.name === name);
    if (found) return editor.open(await levelOf(found));
  }
  throw new Error(`there is no level ${name}`);
}

/** @param {Editor} editor @returns {string | null} */
function askName(editor) {
  const proposed = `${String(editor.document.name).replace(/[^\w-]+/g, "_")}.json`;
  return prompt("Save as which file of the directory?", proposed);
}

/** Keys go to play while a level is played, to the editor otherwise; never while text is typed.
 * @param {Editor} editor @param {Play} play @param {() => void} start */
function useKeys(editor, play, start) {
  const latest = useRef(start);
  latest.current = start;
  useEffect(() => {
    const down = (/** @type {KeyboardEvent} */ event) => {
      const target = /** @type {Element} */ (event.target);
      const isOnButton = target instanceof HTMLButtonElement || target instanceof HTMLAnchorElement;
      if (target.matches("select, textarea, input:not([type=range]):not([type=checkbox])")) return;
      const key = keyOf(event);
      if (key === "ctrl+s") {
        event.preventDefault();
        /** @type {HTMLButtonElement | null} */ (document.querySelector("[title='Ctrl+S']"))?.click();
      } else if (key === " " && !isOnButton) {
        event.preventDefault();
        latest.current();
      } else if (play.isOpen) {
        if (playKey(play, key) || play.press(event.key, true)) event.preventDefault();
      } else if (key === "escape" && play.problem) {
        event.preventDefault();
        void play.close();
      } else {
        // Tab goes on through the page but from the picture; Enter is that of a button that has the focus.
        if (key.endsWith("tab") && !target.matches(".editor-canvas")) return;
        if (key === "enter" && isOnButton) return;
        const command = commandOf(key);
        if (!command || ["ctrl+c", "ctrl+x", "ctrl+v"].includes(key)) return; // these come as events of the clipboard
        event.preventDefault();
        command.run(editor, key);
      }
    };
    const up = (/** @type {KeyboardEvent} */ event) => void (play.isOpen && play.press(event.key, false));
    const leave = () => play.release();
    const isFree = (/** @type {ClipboardEvent} */ event) => !play.isOpen && !/** @type {Element} */ (event.target).matches("input, textarea");
    const pasted = (/** @type {ClipboardEvent} */ event) => {
      const text = event.clipboardData?.getData("text/plain") ?? "";
      if (isFree(event) && (text.trim().startsWith("{") || linked(text) !== null)) void openText(editor, text);
    };
    const copy = (/** @type {ClipboardEvent} */ event) => {
      if (!isFree(event) || !getSelection()?.isCollapsed || !editor.selection.length) return;
      event.clipboardData?.setData("text/plain", JSON.stringify(copied(editor.settled, editor.selection)));
      event.preventDefault();
      commandOf(event.type === "cut" ? "ctrl+x" : "ctrl+c")?.run(editor, "");
    };
    addEventListener("keydown", down);
    addEventListener("keyup", up);
    addEventListener("blur", leave);
    addEventListener("paste", pasted);
    addEventListener("copy", copy);
    addEventListener("cut", copy);
    return () => {
      removeEventListener("keydown", down);
      removeEventListener("keyup", up);
      removeEventListener("blur", leave);
      removeEventListener("paste", pasted);
      removeEventListener("copy", copy);
      removeEventListener("cut", copy);
    };
  }, [editor, play]);
}

function Help() {
  const row = (/** @type {string} */ keys, /** @type {string} */ text) => html`<tr key=${keys + text}><td><kbd>${keys}</kbd></td><td>${text}</td></tr>`;
  return html`<section class="panel" data-panel="help"><header><h3>Keys</h3></header>
    <table><tbody>
      ${row("space", "play, or edit")}${row("ctrl+s", "save")}${row("alt", "held: no snapping")}
      ${COMMANDS.map((command) => row(command.keys.join(" "), command.label))}
    </tbody></table>
    <header><h3>While a level is played</h3></header>
    <table><tbody>${row("→ ← · ↑ ↓ · D A · W S", "motors 0, 1, 2, 3 forward and backward")}${row("1 · 2", "thrusters 0, 1")}
      ${Object.entries(PLAY_KEYS).map(([key, [text]]) => row(key, text))}</tbody></table>
  </section>`;
}
