// What fails in a set: solve rates by features of levels, each group against all others, and pictures of its least solved levels.
import { setQuery, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { percent } from "../base/format.js";
import { html, useState } from "../base/html.js";
import { Panel } from "../charts/panel.js";
import { getPalette, Picture } from "../world/picture.js";
import { points } from "./evaluated_level.js";

const THUMBNAIL = 128; // pixels
const AT_FIRST = 6; // pictures of each group
/** @type {Record<string, string>} */
const TITLES = { joints: "number of joints", motors: "number of motors", thrusters: "number of thrusters", shapes: "number of shapes",
  fixed_shapes: "number of fixed shapes", red_shapes: "number of red shapes", distance: "distance of green and blue at the start", family: "family (beginning of the name)" };

/** @param {string} feature */
const titleOf = (feature) => TITLES[feature] ?? feature.replace("_", " ");
/** @param {any} rate */
const rateText = (rate) => `${percent(rate.rate)} (${rate.solved} of ${rate.attempts} attempts${rate.low === null ? "" : `; 95 % ${percent(rate.low)} to ${percent(rate.high)}`})`;

/**
 * @param {{ run: string, set: string, rows: import("./evaluated_levels.js").Row[], features: any, problem: string | null }} props
 * rows: all levels of the set; features: answer of the server, null while there is none
 */
export function FailingLevels({ run, set, rows, features, problem }) {
  const { query } = useAddress();
  const title = `What fails in ${set}`;
  if (!features) return html`<${Panel} title=${title} wide=${true} missing=${problem ?? "The engine builds the levels of this set: some seconds the first time ..."} />`;
  const { groupings } = features;
  const clear = groupings.filter((/** @type {any} */ one) => one.is_clear);
  const unclear = groupings.filter((/** @type {any} */ one) => !one.is_clear);
  const wanted = query.get("group") ?? clear[0]?.feature ?? "none";
  const grouping = groupings.find((/** @type {any} */ one) => one.feature === wanted);
  const csv = () => [["feature", "group", "levels", "solved", "attempts", "low", "high", "others_solved", "others_attempts", "difference", "difference_low", "difference_high"],
    ...groupings.flatMap((/** @type {any} */ one) => one.groups.map((/** @type {any} */ g) => [one.feature, g.label, g.levels.length, g.solved, g.attempts, g.low, g.high, g.others.solved, g.others.attempts, g.difference?.value ?? null, g.difference?.low ?? null, g.difference?.high ?? null]))];
  return html`<${Panel} title=${title} help="newest evaluation; a group against all other levels of the set" rows=${csv} name=${`${run} ${title}`} picture=${false} wide=${true}>
    <p>${clear.length ? "Features that go with failing, those that explain most first. What goes with failing need not be its cause." : "No feature of these levels goes clearly with failing: every difference below could be chance."}</p>
    ${clear.map((/** @type {any} */ one) => html`<${Grouping} key=${one.feature} one=${one} />`)}
    ${unclear.length ? html`<details open=${!clear.length && unclear.length < 3}><summary>${unclear.length} ${unclear.length === 1 ? "feature" : "features"} whose differences could be chance</summary>${unclear.map((/** @type {any} */ one) => html`<${Grouping} key=${one.feature} one=${one} />`)}</details>` : null}
    <p class="soft">Intervals of rates are 95 %, with levels as the sample. Those of differences hold for all ${groupings.reduce((/** @type {number} */ sum, /** @type {any} */ one) => sum + one.groups.length, 0)} groups together (Bonferroni).</p>
    <div class="row"><h3>Least solved levels</h3><label>grouped by <select onChange=${(/** @type {any} */ e) => setQuery({ group: e.target.value })}>
      <option value="none" selected=${!grouping}>nothing</option>
      ${groupings.map((/** @type {any} */ one) => html`<option key=${one.feature} value=${one.feature} selected=${one === grouping}>${titleOf(one.feature)}</option>`)}</select></label></div>
    ${grouping ? [...grouping.groups].sort((a, b) => a.rate - b.rate).map((group) => html`<${Thumbnails} key=${`${wanted} ${group.label}`} run=${run} set=${set} title=${`${group.label}: ${rateText(group)}`} rows=${group.levels.map((/** @type {number} */ k) => rows[k])} />`)
      : html`<${Thumbnails} key="all" run=${run} set=${set} title="" rows=${rows} />`}
  </${Panel}>`;
}

/** @param {{ one: any }} props a feature and its groups */
function Grouping({ one }) {
  const groups = [...one.groups].sort((a, b) => a.rate - b.rate);
  return html`<p class="groups">${titleOf(one.feature)}${one.same.map((/** @type {string} */ other) => `, or ${titleOf(other)}, which is the same here`)}: explains ${percent(one.explained)} of what differs between levels</p>
    <div class="scroll"><table class="groups tight"><thead><tr><th>levels with</th><th class="number">levels</th><th>solved</th><th>all others</th><th>difference</th></tr></thead>
    <tbody>${groups.map((group) => html`<tr key=${group.label}><td>${group.label}</td><td class="number">${group.levels.length}</td><td>${rateText(group)}</td><td>${rateText(group.others)}</td>
      <td class=${group.is_clear && group.difference.value < 0 ? "bad" : ""}>${group.difference ? `${points(group.difference.value)} points (${points(group.difference.low)} to ${points(group.difference.high)})` : "of too few levels"}${group.difference && !group.is_clear ? html`<span class="soft">, could be chance</span>` : ""}</td></tr>`)}</tbody></table></div>`;
}

/** The least solved of some levels. @param {{ run: string, set: string, title: string, rows: import("./evaluated_levels.js").Row[] }} props */
function Thumbnails({ run, set, title, rows }) {
  const [count, setCount] = useState(title ? AT_FIRST : 2 * AT_FIRST);
  const palette = useRequest(getPalette, []);
  const worst = [...rows].sort((a, b) => (a.now?.rate ?? 1) - (b.now?.rate ?? 1) || a.index - b.index).slice(0, count);
  const indices = worst.map((row) => row.index).join(",");
  const pictures = useRequest(() => get(`runs/${encodeURIComponent(run)}/evaluations/thumbnails`, { set, indices }), [run, set, indices]);
  const drawn = new Map((pictures.data ?? []).map((/** @type {any} */ entry) => [entry.index, entry]));
  return html`<section>${title ? html`<h3 class="section">${title}</h3>` : null}
    ${pictures.error ? html`<p class="missing">${pictures.error}</p>` : null}
    <div class="thumbnails">${worst.map((row) => {
      const picture = drawn.get(row.index);
      return html`<button key=${row.index} class="thumbnail" title=${row.name} onClick=${() => setQuery({ level: row.key })}>
        ${picture && palette.data ? html`<${Picture} display=${picture.display} poses=${picture.poses} palette=${palette.data} size=${THUMBNAIL} label=${`level ${row.name}`} />` : html`<span class="blank"></span>`}
        <span class="caption">${row.name}</span><span>${row.now ? `${row.now.solved} of ${row.now.attempts} solved` : ""}</span></button>`;
    })}</div>
    ${rows.length > count ? html`<button class="more" onClick=${() => setCount(2 * count)}>more of ${rows.length}</button>` : null}
  </section>`;
}
