// Levels of a buffer as thumbnails: sorted, filtered, and one of them in a drawer.
import { setQuery, useAddress } from "../base/address.js";
import { ApiError, get, useRequest } from "../base/api.js";
import { short } from "../base/format.js";
import { html, useEffect, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { Term } from "../base/term.js";
import { getPalette, Picture } from "../world/picture.js";
import { LevelDrawer } from "./level_drawer.js";
import { Notes } from "./parts.js";
import { useRunChanges } from "./run_changes.js";

const A_PAGE = 96;
const THUMBNAIL = 128;
/** @type {Record<string, string>} */
const SORTS = {
  "slot up": "slot", "score down": "highest score first", "score up": "lowest score first",
  "p down": "most solved first", "p up": "least solved first",
  "p_training down": "most solved in training first", "p_training up": "least solved in training first",
  "attempts_training down": "most played in training first",
  "shapes down": "most shapes first", "joints down": "most joints first",
};

/** @param {{ run: string }} props */
export function LevelsPage({ run }) {
  const { query } = useAddress();
  const changes = useRunChanges(run);
  const base = `runs/${encodeURIComponent(run)}/curriculum`;
  const all = useRequest(() => get(base), [run, changes]);
  const palette = useRequest(getPalette, []);
  // In a fast run, levels are left out and files removed between this list and requests by it: those are
  // dropped without a word until the list comes again.
  const [gone, setGone] = useState(/** @type {string[]} */ ([]));
  useEffect(() => setGone([]), [all.data]);
  const snapshots = (all.data?.snapshots ?? []).filter((/** @type {any} */ s) => !gone.includes(nameOf(s)));
  const of = query.get("of");
  const chosen = snapshots.find((/** @type {any} */ s) => nameOf(s) === of) ?? snapshots.findLast((/** @type {any} */ s) => s.has_levels) ?? snapshots.at(-1);
  const sort = query.get("sort") ?? "slot up";
  const filter = query.get("filter") ?? "";
  const offset = Number(query.get("offset") ?? 0);
  const [field, order] = sort.split(" ");
  const page = useRequest(
    () => (chosen ? get(`${base}/${chosen.kind}/${chosen.number}/levels`, { sort: field, order, filter, offset, limit: A_PAGE }).then((found) => present(found, found.has_levels || !chosen.has_levels)) : Promise.resolve(null)),
    [run, chosen?.kind, chosen?.number, sort, filter, offset, changes],
  );
  const indices = (page.data?.levels ?? []).map((/** @type {any} */ level) => level.index);
  const pictures = useRequest(
    () => (page.data?.has_levels && indices.length ? get(`${base}/${chosen.kind}/${chosen.number}/thumbnails`, { indices: indices.join(",") }).then((found) => present(found, found.length > 0)) : Promise.resolve([])),
    [run, chosen?.kind, chosen?.number, indices.join(",")],
  );
  const isGone = page.isGone || pictures.isGone;
  useEffect(() => {
    if (isGone && chosen) setGone([...gone, nameOf(chosen)]);
  }, [isGone]);
  const drawn = new Map((pictures.data ?? []).map((/** @type {any} */ entry) => [entry.index, entry]));
  const open = query.get("level");
  const level = page.data?.levels.find((/** @type {any} */ entry) => String(entry.index) === open);
  const notes = [all.error, isGone ? null : page.error, isGone ? null : (pictures.error ?? palette.error), ...(all.data?.problems ?? [])].filter(Boolean);
  if (!all.data) return html`<main><${Notes} notes=${notes} /></main>`;
  return html`<main>
    <${Notes} notes=${notes} />
    ${snapshots.length ? null : html`<p class="missing">No snapshots of its curriculum so far (curriculum/*.npz). ${all.data.expected.buffer}</p>`}
    ${chosen ? html`<div class="row bar">
      <${Term} name="snapshot" /> <label><select aria-label="snapshot" onChange=${(/** @type {any} */ e) => setQuery({ of: e.target.value, offset: null, level: null })}>
        ${snapshots.map((/** @type {any} */ s) => html`<option key=${nameOf(s)} value=${nameOf(s)} selected=${s === chosen}>${s.kind} ${s.number}${s.has_levels ? "" : " (levels left out)"}</option>`)}</select></label>
      <label>order <select onChange=${(/** @type {any} */ e) => setQuery({ sort: e.target.value, offset: null })}>
        ${Object.entries(SORTS).filter(([key]) => key === sort || key.startsWith("slot") || page.data?.columns.includes(key.split(" ")[0])).map(([key, text]) => html`<option key=${key} value=${key} selected=${key === sort}>${text}</option>`)}</select></label>
      <${Filter} value=${filter} columns=${page.data?.columns ?? []} />
      <span class="soft">${page.data ? `${page.data.matching} of ${count(page.data.total, "level")}` : ""}</span>
      <button class=${offset ? "" : "off"} onClick=${() => setQuery({ offset: String(Math.max(0, offset - A_PAGE)) })}>◀</button>
      <button class=${offset + A_PAGE < (page.data?.matching ?? 0) ? "" : "off"} onClick=${() => setQuery({ offset: String(offset + A_PAGE) })} aria-label="more levels">▶</button>
    </div>` : null}
    ${page.data && !page.data.has_levels ? html`<p class="missing">Levels of this snapshot were left out to save space (curriculum_log.max_snapshots); its counts are here.</p>` : null}
    ${pictures.isLoading && indices.length ? html`<p class="soft" role="status">drawing levels; the first picture waits for the engine worker to start ...</p>` : null}
    <div class=${level ? "with-drawer" : ""}>
      <div class="thumbnails">${(page.data?.levels ?? []).map((/** @type {any} */ entry) => {
        const picture = drawn.get(entry.index);
        return html`<button key=${entry.index} class=${`thumbnail${String(entry.index) === open ? " chosen" : ""}`} onClick=${() => setQuery({ level: String(entry.index) })}>
          ${picture && palette.data ? html`<${Picture} display=${picture.display} poses=${picture.poses} palette=${palette.data} size=${THUMBNAIL} label=${`level ${entry.index}`} />` : html`<span class="blank"></span>`}
          <span>${caption(entry)}</span></button>`;
      })}</div>
      ${level ? html`<${LevelDrawer} run=${run} snapshot=${chosen} level=${level} picture=${drawn.get(level.index)} changes=${changes} />` : null}
    </div>
  </main>`;
}

/** @param {{ kind: string, number: number }} snapshot */
function nameOf(snapshot) {
  return `${snapshot.kind} ${snapshot.number}`;
}

/** An answer, unless levels were left out since the list was made. @template T @param {T} answer @param {boolean} isPresent */
function present(answer, isPresent) {
  if (!isPresent) throw new ApiError("the levels of this snapshot were left out", 404);
  return answer;
}

/** @param {any} level */
function caption(level) {
  const counts = level.training?.episodes ? level.training : level.scored;
  if (!counts) return `score ${short(level.score)}`;
  return `${counts.solved} of ${counts.episodes} solved${level.training?.episodes ? " in training" : ""}`;
}

/** @param {{ value: string, columns: string[] }} props */
function Filter({ value, columns }) {
  const [text, setText] = useState(value);
  const apply = () => setQuery({ filter: text, offset: null });
  return html`<label>filter <input value=${text} placeholder="joints>=1 p<0.5" title=${`conditions on ${columns.join(", ")}`} onInput=${(/** @type {any} */ e) => setText(e.target.value)}
    onChange=${apply} onKeyDown=${(/** @type {any} */ e) => e.key === "Enter" && apply()} /></label>`;
}
