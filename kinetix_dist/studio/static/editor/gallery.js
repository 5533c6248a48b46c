// The gallery: designed sets, files of the command line, and what can be made anew.
import { get, useRequest } from "../base/api.js";
import { html, useMemo, useState } from "../base/html.js";
import { levelPicture } from "../world/display_list.js";
import { Picture } from "../world/picture.js";
import { readLevel } from "./files.js";

const THUMBNAIL = 118;

/** @typedef {{ name: string, text?: string, problem?: string }} Entry */

/** @param {{ about: any, engine: import("../world/display_list.js").Engine, openDesigned: (entry: Entry) => void, openFile: (name: string) => void,
 *   openText: (text: string) => void }} props */
export function Gallery({ about, engine, openDesigned, openFile, openText }) {
  const [of, setOf] = useState(about.files ? "files" : "all_designed_s");
  const listed = useRequest(() => (of === "files" ? get("files") : get(`levels/sets/${of}`)), [of]);
  const entries = /** @type {Entry[]} */ (listed.data?.files ?? listed.data?.levels ?? []);
  const chosen = about.sets.find((/** @type {any} */ set) => set.name === of);
  return html`<section class="panel" data-panel="gallery"><header><h3>Levels</h3>
      <select aria-label="set" onChange=${(/** @type {any} */ e) => setOf(e.target.value)}>
        ${about.files ? html`<option value="files" selected=${of === "files"}>files of ${about.files.directory}</option>` : null}
        ${about.sets.map((/** @type {any} */ set) => html`<option key=${set.name} value=${set.name} selected=${set.name === of}>${set.name} (${set.count})</option>`)}</select></header>
    <label class="field from-link"><span>link or text</span><input type="text" aria-label="link or text of a level" placeholder="paste it here" value=""
      onInput=${(/** @type {any} */ e) => { const text = e.target.value; if (text.trim()) { e.target.value = ""; openText(text); } }} /></label>
    <p class="soft">${chosen?.description ?? ""}</p>
    ${listed.error ? html`<p class="bad">${listed.error}</p>` : null}
    ${of === "files" && listed.data && !entries.length ? html`<p class="missing">There is no level file yet; what you make is saved here.</p>` : null}
    <div class="thumbnails">${entries.map((entry) => html`<${Thumbnail} key=${`${of} ${entry.name}`} entry=${entry} engine=${engine} open=${() => (of === "files" ? openFile(entry.name) : openDesigned(entry))} />`)}</div>
  </section>`;
}

/** @param {{ entry: Entry, engine: import("../world/display_list.js").Engine, open: () => void }} props */
function Thumbnail({ entry, engine, open }) {
  const picture = useMemo(() => {
    try {
      return entry.text && !entry.text.includes('"env_state"') ? levelPicture(JSON.parse(entry.text), engine) : null;
    } catch {
      return null; // shown when it is opened
    }
  }, [entry.text, engine]);
  const poses = picture ? Array.from({ length: picture.poses.length / 3 }, (_, k) => picture.poses.slice(3 * k, 3 * k + 3)) : [];
  return html`<button class="thumbnail" onClick=${open} title=${entry.problem ?? entry.name}>
    ${picture ? html`<${Picture} display=${picture.display} poses=${poses} palette=${engine.palette} size=${THUMBNAIL} label=${entry.name} />` : html`<span class="blank">${entry.problem ? "✗" : "?"}</span>`}
    <span>${entry.name}</span></button>`;
}

/** Text of a set's level as a level. @param {Entry} entry */
export const levelOf = (entry) => readLevel(entry.text ?? "");
