// The curriculum of a run: levels chosen by refreshes, their rates in training, learning, and levels that stay.
import { addressOf, setQuery, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { percent, rateOverLevels, rateWithCount, short } from "../base/format.js";
import { html } from "../base/html.js";
import { count, noun } from "../base/language.js";
import { Term } from "../base/term.js";
import { Bars } from "../charts/bars.js";
import { HeatMap } from "../charts/heat_map.js";
import { LineChart } from "../charts/line_chart.js";
import { Panel } from "../charts/panel.js";
import { Notes } from "./parts.js";
import { useRunChanges } from "./run_changes.js";

const NO_SNAPSHOTS = "No snapshots of its curriculum so far (curriculum/refresh_*.npz, buffer_*.npz).";
const NO_OUTCOMES = "No counts of its training episodes so far (curriculum/outcomes.jsonl).";
const MOVES = ["never solved", "sometimes", "always"];
const CHOSEN_WHILE_SCORED = "This curriculum tries some candidates again because of how they fared, and takes fresh levels that training solved: they are no sample of the generator.";

/** @param {{ run: string }} props */
export function CurriculumPage({ run }) {
  const changes = useRunChanges(run);
  const { query } = useAddress();
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/curriculum`), [run, changes]);
  if (!data) return html`<main><${Notes} notes=${error ? [error] : []} /><p class="missing">${error ? "" : "reading snapshots ..."}</p></main>`;
  const refreshes = data.snapshots.filter((/** @type {any} */ entry) => entry.kind === "refresh");
  const buffers = data.snapshots.filter((/** @type {any} */ entry) => entry.kind === "buffer");
  const newest = refreshes.at(-1);
  const learned = refreshes.findLast((/** @type {any} */ entry) => entry.probe); // later ones were not played again yet
  const chosen = refreshes.find((/** @type {any} */ entry) => String(entry.number) === query.get("refresh"))
    ?? learned ?? refreshes.at(-1);
  return html`<main>
    <${Notes} notes=${[...(error ? [error] : []), ...data.problems]} />
    ${data.snapshots.length ? null : html`<p class="missing">${NO_SNAPSHOTS} ${data.expected.buffer}</p>`}
    <div class="grid two">
      <${Sources} run=${run} windows=${data.windows} expected=${data.expected.outcomes} />
      ${refreshes.length ? html`<${Learnability} run=${run} refreshes=${refreshes} />
        <${Distribution} run=${run} refreshes=${refreshes} chosen=${chosen} />
        <${Persistence} run=${run} snapshots=${refreshes} />` : data.windows.length ? html`<${FreshLearnability} run=${run} windows=${data.windows} />` : null}
      ${buffers.length ? html`<${ReplayBuffers} run=${run} buffers=${buffers} />` : null}
    </div>
    ${chosen ? html`<h3 class="section"><${Term} name="refresh">Refresh</${Term}> ${chosen.number}${" "}
      <select aria-label="refresh" onChange=${(/** @type {any} */ e) => setQuery({ refresh: e.target.value })}>
        ${refreshes.map((/** @type {any} */ entry) => html`<option key=${entry.number} value=${entry.number} selected=${entry === chosen}>scored by the policy of update ${entry.number}, in use from update ${entry.first_batch}${entry.probe ? "" : ", what was learned is not known"}</option>`)}
      </select> <a class="button" href=${addressOf(["run", run, "levels"], new URLSearchParams({ of: `refresh ${chosen.number}` }))}>its levels</a></h3>
      ${chosen !== newest && chosen === learned ? html`<p class="soft">It is the newest whose learning is known. The newest of all is <button class="link" onClick=${() => setQuery({ refresh: String(newest.number) })}>refresh ${newest.number}</button>. ${data.expected.learned}</p>` : null}
      <div class="grid two">
        <${Histogram} run=${run} entry=${chosen} />
        <${Counts} run=${run} entry=${chosen} />
        <${Learned} run=${run} entry=${chosen} expected=${chosen === newest ? data.expected.learned : "The refresh after it played no levels again (curriculum_log.probe_every)."} />
      </div><div class="grid">
        ${Object.keys(chosen.by_feature).map((name) => html`<${ByFeature} key=${name} run=${run} name=${name} entry=${chosen} />`)}
      </div>` : null}
  </main>`;
}

/** @param {{ run: string, windows: any[], expected: string }} props expected: when the first window comes */
function Sources({ run, windows, expected }) {
  const names = [...new Set(windows.flatMap((row) => Object.keys(row.sources)))];
  const x = windows.map((row) => row.update);
  const of = (/** @type {string} */ name, /** @type {string} */ field) => windows.map((row) => (row.sources[name]?.episodes ? row.sources[name][field] : null));
  const lines = names.map((name) => ({ label: name, values: of(name, "rate"), low: of(name, "low"), high: of(name, "high") }));
  const rows = () => [["from_update", "update", "source", "solved", "episodes", "rate", "low", "high"],
    ...windows.flatMap((row) => Object.entries(row.sources).map(([name, c]) => [row.from_update, row.update, name, c.solved, c.episodes, c.rate, c.low, c.high]))];
  const last = windows.at(-1);
  return html`<${Panel} title="Solve rate in training, by where levels come from" help="attempts: the first episode of each world in an update; 95 % intervals of each window" rows=${rows} name=${`${run} sources`} missing=${windows.length ? null : `${NO_OUTCOMES} ${expected}`}>
    <${LineChart} x=${x} lines=${lines} axis="updates" />
    <p class="keys">${last ? `updates ${last.from_update} to ${last.update}: ${Object.entries(last.sources).map(([name, c]) => `${name} ${rateWithCount(c.solved, c.episodes)}`).join(" · ")}` : ""}</p>
  </${Panel}>`;
}

/** @param {{ run: string, refreshes: any[] }} props */
function Learnability({ run, refreshes }) {
  const x = refreshes.map((entry) => entry.first_batch);
  const found = refreshes.map((entry) => entry.training?.learnability ?? null);
  const error = refreshes.map((entry) => entry.training?.learnability_error ?? null);
  const fresh = refreshes.map((entry) => entry.candidates.learnability);
  const freshError = refreshes.map((entry) => entry.candidates.learnability_error);
  const around = (/** @type {any[]} */ values, /** @type {any[]} */ errors, /** @type {number} */ sign) => values.map((value, k) => (value === null || errors[k] === null ? value : value + sign * 1.96 * errors[k]));
  const lines = [
    { label: "claimed, of the buffer", values: refreshes.map((entry) => entry.buffer.claimed) },
    { label: "in training, of the buffer", values: found, low: around(found, error, -1), high: around(found, error, 1) },
    { label: "fresh levels: all candidates", values: fresh, low: around(fresh, freshError, -1), high: around(fresh, freshError, 1) },
    ...pairLines(refreshes),
  ];
  const last = refreshes.findLast((entry) => entry.training);
  const rows = () => [["refresh", "in_use_from", "claimed_buffer", "episodes", "fresh", "fresh_standard_error", "training", "standard_error", "levels_played_twice", "attempts_in_training", ...PAIR_COLUMNS],
    ...refreshes.map((entry) => [entry.number, entry.first_batch, entry.buffer.claimed, entry.buffer.episodes, entry.candidates.learnability, entry.candidates.learnability_error, entry.training?.learnability ?? null, entry.training?.learnability_error ?? null, entry.training?.learnability_levels ?? null, entry.training?.episodes ?? null, ...pairCells(entry.fresh_pairs)])];
  return html`<${Panel} title="Learnability p (1 - p): claimed and in training" rows=${rows} name=${`${run} learnability`}
    help="Claimed: from the few episodes by which levels were chosen, so too high. In training: s (f - s) / (f (f - 1)) of s solved of f attempts, over levels played twice or more. Fresh levels: the same of all candidates, where each finished two episodes or more; in training, half of the share of pairs of worlds with the same fresh level of which one solved it. Bands 95 %.">
    <${LineChart} x=${x} lines=${lines} axis="in use from update" />
    <${PairsText} entries=${refreshes} />
    <p class="keys">${last ? `buffer ${last.number}: claimed ${short(last.buffer.claimed)} (${count(last.buffer.episodes, "episode")} of ${count(last.buffer.levels, "level")}), in training ${short(last.training.learnability)} (${count(last.training.episodes, "attempt")}, ${count(last.training.learnability_levels, "level")} played twice or more)` : "No buffer was played to the end of a window yet."}</p>
  </${Panel}>`;
}

const FRESH_IN_TRAINING = "fresh levels: in training";
const PAIR_COLUMNS = ["fresh_in_training", "fresh_low", "fresh_high", "pairs_both_solved", "pairs_one_solved", "pairs_none_solved"];

/** The line of fresh levels in training; none where the run does not record it. @param {any[]} entries with fresh_pairs */
function pairLines(entries) {
  const of = (/** @type {string} */ field) => entries.map((entry) => entry.fresh_pairs?.[field] ?? null);
  return entries.some((entry) => entry.fresh_pairs) ? [{ label: FRESH_IN_TRAINING, values: of("learnability"), low: of("low"), high: of("high") }] : [];
}

/** @param {any} pairs */
function pairCells(pairs) {
  return ["learnability", "low", "high", "both", "one", "none"].map((field) => pairs?.[field] ?? null);
}

/** @param {{ entries: any[] }} props */
function PairsText({ entries }) {
  const pairs = entries.findLast((entry) => entry.fresh_pairs)?.fresh_pairs;
  return html`<p class="keys">${FRESH_IN_TRAINING} ${pairs ? `${short(pairs.learnability)} (${short(pairs.low)} to ${short(pairs.high)}): one of two worlds solved it in ${pairs.one} of ${pairs.pairs} pairs` : "not recorded by this run"}</p>`;
}

/** Of a curriculum without refreshes. @param {{ run: string, windows: any[] }} props */
function FreshLearnability({ run, windows }) {
  const recorded = windows.filter((row) => row.fresh_pairs);
  const rows = () => [["from_update", "update", ...PAIR_COLUMNS], ...recorded.map((row) => [row.from_update, row.update, ...pairCells(row.fresh_pairs)])];
  return html`<${Panel} title="Learnability p (1 - p) of fresh levels in training" rows=${rows} name=${`${run} fresh learnability`}
    help="half of the share of pairs of worlds with the same fresh level of which one solved it; 95 % intervals of each window"
    missing=${recorded.length ? null : "Learnability of fresh levels in training: not recorded by this run."}>
    <${LineChart} x=${recorded.map((row) => row.update)} lines=${pairLines(recorded)} axis="updates" />
    <${PairsText} entries=${recorded} /></${Panel}>`;
}

/** @param {{ run: string, refreshes: any[], chosen: any }} props */
function Distribution({ run, refreshes, chosen }) {
  const num = chosen.buffer.histogram.length;
  const label = (/** @type {number} */ k) => (k === 0 ? "p = 0" : k === num - 1 ? "p = 1" : `${percentOf(k - 1, num - 2)} to ${percentOf(k, num - 2)}`);
  const order = [...Array(num).keys()].reverse();
  const total = (/** @type {any} */ entry) => entry.buffer.histogram.reduce((/** @type {number} */ a, /** @type {number} */ b) => a + b, 0);
  const values = order.map((k) => refreshes.map((entry) => (total(entry) ? entry.buffer.histogram[k] / total(entry) : null)));
  const texts = order.map((k) => refreshes.map((entry) => `buffer ${entry.number}: ${entry.buffer.histogram[k]} of ${count(total(entry), "level")} with ${label(k)}, ${count(entry.buffer.episodes, "episode")} in all`));
  const rows = () => [["refresh", ...order.map(label)], ...refreshes.map((entry) => [entry.number, ...order.map((k) => entry.buffer.histogram[k])])];
  return html`<${Panel} title="Solve rates of the buffer's levels over time" help="share of levels a bin, % ; click a column" rows=${rows} name=${`${run} p over time`}>
    <${HeatMap} rows=${order.map(label)} columns=${refreshes.map((entry) => String(entry.number))} values=${values} texts=${texts} labelWidth=${90}
      chosen=${refreshes.indexOf(chosen)} choose=${(/** @type {number} */ _, /** @type {number} */ c) => setQuery({ refresh: String(refreshes[c].number) })}
      describe="share of levels by solve rate, a column a refresh" /></${Panel}>`;
}

/** @param {number} k @param {number} of */
function percentOf(k, of) {
  return `${Math.round((100 * k) / of)} %`;
}

/** @param {{ run: string, snapshots: any[] }} props */
function Persistence({ run, snapshots }) {
  const later = snapshots.filter((entry) => entry.retained !== undefined);
  const retained = later.map((entry) => entry.retained);
  const isPlain = later.length && retained.every((count) => count === 0);
  const rows = () => [["refresh", "retained", "levels"], ...later.map((entry) => [entry.number, entry.retained, entry.num_levels])];
  return html`<${Panel} title="What persists from refresh to refresh" help="levels that the buffer before had too" rows=${rows} name=${`${run} persistence`}
    missing=${later.length ? null : "There is one refresh so far."}>
    ${isPlain ? html`<p>0 of ${count(later.at(-1).num_levels, "level")}, ${later.length === 1 ? "in the one refresh" : `in each of ${later.length} refreshes`} after the first. Plain SFL draws all candidates afresh, so that no level persists, by construction.</p>`
      : html`<${LineChart} x=${later.map((entry) => entry.first_batch)} lines=${[{ label: "levels retained", values: retained }]} axis="in use from update" />`}
  </${Panel}>`;
}

/** @param {{ run: string, buffers: any[] }} props */
function ReplayBuffers({ run, buffers }) {
  const x = buffers.map((entry) => entry.number);
  const lines = [{ label: "levels", values: buffers.map((entry) => entry.num_levels) }, { label: "of these in the snapshot before", values: buffers.map((entry) => entry.retained ?? null) }];
  const rows = () => [["update", "levels", "retained", "mean_score"], ...buffers.map((entry) => [entry.number, entry.num_levels, entry.retained ?? null, entry.mean_score])];
  const of = buffers.at(-1);
  return html`<${Panel} title="Replay buffer: levels" rows=${rows} name=${`${run} replay buffer`} help="at each checkpoint; parents of levels are not recorded"
    buttons=${html`<a class="button" href=${addressOf(["run", run, "levels"], new URLSearchParams({ of: `buffer ${of.number}` }))}>its levels</a>`}>
    <${LineChart} x=${x} lines=${lines} axis="updates" /></${Panel}>
  <${Panel} title="Replay buffer: mean score" name=${`${run} replay score`} rows=${rows}>
    <${LineChart} x=${x} lines=${[{ label: "mean score", values: buffers.map((entry) => entry.mean_score) }]} axis="updates" /></${Panel}>`;
}

/** @param {{ run: string, entry: any }} props */
function Histogram({ run, entry }) {
  const num = entry.buffer.histogram.length;
  const columns = [...Array(num).keys()].map((k) => (k === 0 ? "0" : k === num - 1 ? "1" : `.${k - 1}`));
  const group = (/** @type {string} */ label, /** @type {any} */ of) => {
    const total = of.histogram.reduce((/** @type {number} */ a, /** @type {number} */ b) => a + b, 0);
    return { label: `${label} (${count(total, "level")}, ${count(of.episodes, "episode")})`, values: of.histogram.map((/** @type {number} */ count) => (total ? count / total : null)), texts: of.histogram.map((/** @type {number} */ number) => `${number} of ${count(total, "level")}`) };
  };
  const groups = [group("candidates", entry.candidates), group("buffer", entry.buffer), ...(entry.training ? [group("buffer, in training", entry.training)] : [])];
  const rows = () => [["p", ...groups.map((one) => one.label)], ...columns.map((column, k) => [column, ...groups.map((one) => one.values[k])])];
  return html`<${Panel} title="Solve rates: candidates and buffer" help="share of levels by p; .4 stands for 40 to 50 %, 0 and 1 for never and always" rows=${rows} name=${`${run} histogram ${entry.number}`}>
    <${Bars} columns=${columns} groups=${groups} axis="p = solved / episodes" describe="histogram of solve rates" format=${(/** @type {number} */ value) => `${Math.round(100 * value)} %`} /></${Panel}>`;
}

/** @param {{ run: string, entry: any }} props */
function Counts({ run, entry }) {
  const table = entry.candidates.counts;
  const most = Math.min(12, Math.max(...table.map((/** @type {number[]} */ row) => row[1])));
  const beyond = table.filter((/** @type {number[]} */ row) => row[1] > most).reduce((/** @type {number} */ sum, /** @type {number[]} */ row) => sum + row[2], 0);
  const at = new Map(table.map((/** @type {number[]} */ [s, f, n]) => [`${s} ${f}`, n]));
  const total = entry.candidates.levels;
  const chosen = new Map(entry.buffer.counts.map((/** @type {number[]} */ [s, f, n]) => [`${s} ${f}`, n]));
  const numbers = [...Array(most + 1).keys()];
  const highest = Math.max(1, ...table.filter((/** @type {number[]} */ row) => row[1] <= most).map((/** @type {number[]} */ row) => row[2]));
  const values = [...numbers].reverse().map((s) => numbers.map((f) => (at.has(`${s} ${f}`) ? at.get(`${s} ${f}`) / highest : null)));
  const texts = [...numbers].reverse().map((s) => numbers.map((f) => `${s} of ${count(f, "episode")} solved: ${at.get(`${s} ${f}`) ?? 0} of ${count(total, "candidate")}, ${chosen.get(`${s} ${f}`) ?? 0} of them chosen`));
  const rows = () => [["solved", "finished", "candidates", "chosen"], ...table.map((/** @type {number[]} */ [s, f, n]) => [s, f, n, chosen.get(`${s} ${f}`) ?? 0])];
  return html`<${Panel} title="Solved x finished, of the candidates" help="levels, 100 for the most frequent pair" rows=${rows} name=${`${run} counts ${entry.number}`}>
    <${HeatMap} rows=${[...numbers].reverse().map((s) => `${s} solved`)} columns=${numbers.map((f) => `${f} fin.`)} values=${values} texts=${texts} labelWidth=${70} cellWidth=${46} cellHeight=${22} describe="candidates by solved and finished episodes" />
    ${beyond ? html`<p class="soft">${count(beyond, "candidate")} finished more than ${most} ${noun(most, "episode")}; the CSV has them.</p>` : null}</${Panel}>`;
}

/** @param {{ run: string, entry: any, expected: string }} props expected: why it is not known, or when it will be */
function Learned({ run, entry, expected }) {
  const probe = entry.probe;
  const rows = () => [["before", "after", "levels"], ...probe.moves.map((/** @type {number[]} */ [a, b, n]) => [MOVES[a], MOVES[b], n])];
  const total = probe ? probe.moves.reduce((/** @type {number} */ sum, /** @type {number[]} */ row) => sum + row[2], 0) : 0;
  const values = MOVES.map((_, a) => MOVES.map((__, b) => (probe?.moves.find((/** @type {number[]} */ row) => row[0] === a && row[1] === b)?.[2] ?? 0) / Math.max(total, 1)));
  const texts = MOVES.map((before, a) => MOVES.map((after, b) => `${before} before, ${after} after: ${probe?.moves.find((/** @type {number[]} */ row) => row[0] === a && row[1] === b)?.[2] ?? 0} of ${count(total, "level")}`));
  return html`<${Panel} title="What was learned from this buffer" rows=${rows} name=${`${run} learned ${entry.number}`}
    help="the same levels, played again by the policy of the next refresh"
    missing=${probe ? null : expected}>
    ${probe ? html`<p>${rateOverLevels(probe.before)} when they were chosen, ${" "}
      ${rateOverLevels(probe.after)} at refresh ${probe.policy_version}${" "}
      (95 % interval ${percent(probe.after.low)} to ${percent(probe.after.high)}); learnability now ${short(probe.after_learnability)}.
      Of the difference a part is chance, since few episodes chose these levels: the first window of training shows how much.</p>
      <${HeatMap} rows=${MOVES.map((name) => `${name} before`)} columns=${MOVES.map((name) => `${name}`)} values=${values} texts=${texts} labelWidth=${140} cellWidth=${90} cellHeight=${24} describe="levels by solve rate before and after" />` : null}
  </${Panel}>`;
}

/** @param {{ run: string, name: string, entry: any }} props */
function ByFeature({ run, name, entry }) {
  const found = entry.by_feature[name];
  const group = {
    label: "candidates", values: found.map((/** @type {any} */ f) => f.rate), low: found.map((/** @type {any} */ f) => (f.levels ? f.low : null)), high: found.map((/** @type {any} */ f) => (f.levels ? f.high : null)),
    texts: found.map((/** @type {any} */ f) => `${f.value} ${name.replace("_", " ")}: ${rateOverLevels(f)}`),
  };
  const rows = () => [["value", "levels", "solved", "episodes", "rate", "low", "high"], ...found.map((/** @type {any} */ f) => [f.value, f.levels, f.solved, f.episodes, f.rate, f.low, f.high])];
  return html`<${Panel} title=${`Solve rate by number of ${name.replace("_", " ")}`} help=${`mean over levels. ${entry.is_sample ? "Candidates are an unbiased sample of the generator." : CHOSEN_WHILE_SCORED} 95 % intervals over levels`} rows=${rows} name=${`${run} by ${name} ${entry.number}`}>
    <${Bars} columns=${found.map((/** @type {any} */ f) => String(f.value))} groups=${[group]} axis=${name.replace("_", " ")} max=${1} describe=${`solve rate by ${name}`} format=${(/** @type {number} */ value) => `${Math.round(100 * value)} %`} /></${Panel}>`;
}
