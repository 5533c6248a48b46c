// One level of a buffer next to the thumbnails: its facts, and its history over snapshots and training.
import { get, useRequest } from "../base/api.js";
import { percent, rateWithCount, short } from "../base/format.js";
import { html } from "../base/html.js";
import { LineChart } from "../charts/line_chart.js";
import { featureText, LevelPanel } from "./level_panel.js";
import { Notes } from "./parts.js";

/** @param {{ run: string, snapshot: any, level: any, picture: any, changes: number }} props */
export function LevelDrawer({ run, snapshot, level, picture, changes }) {
  const own = `runs/${encodeURIComponent(run)}/curriculum/${snapshot.kind}/${snapshot.number}/levels/${level.index}`;
  const name = `${run} ${snapshot.kind} ${snapshot.number} ${level.index}`;
  const given = { run, [snapshot.kind]: snapshot.number, index: level.index };
  /** @type {[string, any][]} */
  const facts = [["id", level.id], ["slot", level.index], ["score", short(level.score)]];
  if (level.scored) facts.push(["when it was scored", counted(level.scored)]);
  if (level.training) facts.push(["in training", level.training.episodes ? `${counted(level.training)}` : "not played"]);
  if (level.born !== undefined) facts.push(["came in batch", level.born], ["last played in batch", level.last_played]);
  return html`<${LevelPanel} title=${`Level ${level.index} of ${snapshot.kind} ${snapshot.number}`} run=${run} given=${given} subject=${name}
    label=${`level ${level.index}; keys play it`} picture=${picture} missing="no picture" facts=${facts}
    features=${featureText(level.features)} document=${`${own}/document`}>
    <${History} key=${`history ${name}`} own=${own} changes=${changes} />
  </${LevelPanel}>`;
}

/** Updates at which the level was scored, chosen, played in training and played again. @param {{ own: string, changes: number }} props */
function History({ own, changes }) {
  const { data, error, isGone } = useRequest(() => get(`${own}/history`), [own, changes]);
  if (!data) return html`<${Notes} notes=${error && !isGone ? [error] : []} />`;
  /** @type {{ update: number, what: string, counts: any }[]} */
  const rows = [
    ...data.snapshots.map((/** @type {any} */ one) => ({ update: one.update, what: one.scored ? `scored, refresh ${one.number}` : `in ${one.kind} ${one.number}, score ${short(one.score)}`, counts: one.scored })),
    ...data.windows.map((/** @type {any} */ one) => ({ update: one.update, what: `trained on, updates ${one.from_update} to ${one.update}`, counts: one })),
    ...data.played_again.map((/** @type {any} */ one) => ({ update: one.policy_version, what: `played again at refresh ${one.policy_version}`, counts: one })),
  ].sort((a, b) => a.update - b.update);
  const of = (/** @type {string} */ field) => data.windows.map((/** @type {any} */ one) => one[field]);
  return html`<section data-panel="history"><h3>History</h3>
    ${data.windows.length ? html`<${LineChart} x=${of("update")} lines=${[{ label: "solved in training", values: of("rate"), low: of("low"), high: of("high") }]} axis="updates" height=${130} />` : null}
    <table class="tight"><tbody>${rows.map(({ update, what, counts }) => html`<tr key=${`${update} ${what}`}><td>${what}</td><td class="number">${counts ? rateWithCount(counts.solved, counts.episodes) : ""}</td></tr>`)}</tbody></table>
    ${data.windows.length ? null : html`<p class="missing">It was not played in training so far, or its curriculum does not log which levels were.</p>`}
  </section>`;
}

/** @param {any} counts */
function counted(counts) {
  return `${rateWithCount(counts.solved, counts.episodes)}, 95 % ${percent(counts.low)} to ${percent(counts.high)}`;
}
