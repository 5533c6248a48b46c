// Levels that the engine makes: random changes of this one, and new random ones.
import { channel } from "../base/channel.js";
import { html, useState } from "../base/html.js";

/** @param {{ editor: import("./state.js").Editor }} props */
export function MakePanel({ editor }) {
  const [generator, setGenerator] = useState(editor.engine.generators[0]);
  const [isBusy, setBusy] = useState(false);
  const attempt = async (/** @type {() => Promise<void>} */ act) => {
    setBusy(true);
    try {
      await act();
    } catch (error) {
      editor.notify(error instanceof Error ? error.message : String(error));
    }
    setBusy(false);
  };
  const seed = () => Math.floor(Math.random() * 2 ** 31);
  const mutate = (/** @type {string | null} */ mutator) => attempt(async () => {
    const before = editor.document;
    const answer = await channel.request("mutate", { document: before, mutator, changes: 1, seed: seed() });
    if (before !== editor.document) return editor.notify("the level was changed meanwhile; nothing was mutated");
    if (answer.changed) editor.commit(answer.document, []);
    editor.notify(answer.changed ? `changed: ${mutator ?? "at random"}` : "this mutator finds nothing to change");
  });
  const generate = () => attempt(async () => {
    const [document] = (await channel.request("generate", { size: editor.document.size, generator, seed: seed() })).documents;
    editor.open(document);
    editor.notify("a new random level; undo brings back the one before");
  });
  return html`<section class="panel" data-panel="make"><header><h3>Random</h3><span class="help">changes of this level, or a new one</span></header>
    <div class="row small ${isBusy ? "off" : ""}"><button onClick=${() => mutate(null)}>any change</button>
      ${editor.engine.mutators.map((/** @type {string} */ name) => html`<button key=${name} onClick=${() => mutate(name)}>${name.replaceAll("_", " ")}</button>`)}</div>
    <div class="row small ${isBusy ? "off" : ""}"><select aria-label="generator" onChange=${(/** @type {any} */ e) => setGenerator(e.target.value)}>
      ${editor.engine.generators.map((/** @type {string} */ name) => html`<option key=${name} value=${name} selected=${name === generator}>${name}</option>`)}</select>
      <button onClick=${generate}>new level of size ${editor.document.size}</button></div>
    ${isBusy ? html`<p class="soft" role="status">asking the engine; the first time it compiles ...</p>` : null}
  </section>`;
}
