// Evaluation: levels x evaluations, sorted by what fails or got lost; a level opens; what failing levels have in common.
import { setQuery, useAddress } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { download, interval, percent } from "../base/format.js";
import { html, useEffect, useMemo, useState } from "../base/html.js";
import { LevelMatrix, matrixPicture } from "../charts/level_matrix.js";
import { Panel } from "../charts/panel.js";
import { EvaluatedLevel, countsText, points } from "./evaluated_level.js";
import { changeOfSort, columnsOf, filtered, rowsOf, SORTS, sorted } from "./evaluated_levels.js";
import { FailingLevels } from "./failing_levels.js";
import { Notes } from "./parts.js";
import { useRunChanges } from "./run_changes.js";
import { TrainOnLevels } from "./train_on_levels.js";

const ALL = "all sets";
const WORST = 16; // levels that are chosen at once at first
const NAMES_OF_CHANGES = { last: "since last", first: "since first", best: "since best" };

/** @param {{ run: string }} props */
export function EvaluationPage({ run }) {
  const { query } = useAddress();
  const changes = useRunChanges(run);
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/evaluations/levels`), [run, changes]);
  const notes = [...(error ? [error] : []), ...(data?.problems ?? [])];
  if (!data) return html`<main><${Notes} notes=${notes} /></main>`;
  const names = Object.keys(data.sets);
  const withLevels = names.filter((name) => data.sets[name].names);
  const wanted = query.get("set");
  if (wanted && wanted !== ALL && !names.includes(wanted)) notes.push(`this run has no evaluation set ${wanted}`);
  const set = wanted === ALL || (wanted && withLevels.includes(wanted)) ? wanted : withLevels[0];
  return html`<main>
    <${Notes} notes=${notes} />
    ${names.length ? null : html`<p class="missing">No evaluation so far (evaluations.jsonl). Runs evaluate before and after training, and every evaluation.every updates.</p>`}
    ${data.without_levels && names.length ? html`<p class="missing">This run has no evaluations.jsonl (an older version): rates of whole sets, without levels.</p>` : null}
    ${names.length ? html`<${Sets} run=${run} data=${data} chosen=${set} />` : null}
    ${set ? html`<${Levels} key=${set} run=${run} data=${data} set=${set} withLevels=${withLevels} />` : null}
  </main>`;
}

/** Whole sets: random actions, first, last and newest evaluation. @param {{ run: string, data: any, chosen: string | undefined }} props */
function Sets({ run, data, chosen }) {
  const rate = (/** @type {any} */ point) => (point ? html`<b>${percent(point.rate)}</b> <span class="soft">of ${point.episodes} (${percent(interval(point).low)} to ${percent(interval(point).high)})</span>` : "-");
  const rows = () => [["set", "phase", "update", "env_steps", "rate", "low", "high", "attempts"],
    ...Object.entries(data.sets).flatMap(([name, set]) => set.points.map((/** @type {any} */ p) => [name, p.phase, p.update, p.env_steps, p.rate, p.low, p.high, p.episodes]))];
  return html`<${Panel} title="Evaluation sets" help="share of attempts solved, with 95 % intervals" rows=${rows} name=${`${run} evaluation sets`} picture=${false} wide=${true}>
    <div class="scroll"><table class="sets"><thead><tr><th>set</th><th class="number">levels</th><th>random actions</th><th>before training</th><th>previous</th><th>now</th></tr></thead>
      <tbody>${Object.entries(data.sets).map(([name, set]) => {
        const ofPolicy = set.points.filter((/** @type {any} */ p) => p.phase !== "random_policy");
        return html`<tr key=${name} class=${name === chosen ? "chosen" : ""}><td>${set.names ? html`<button class="link" onClick=${() => setQuery({ set: name, level: null })}>${name}</button>` : name}</td><td class="number">${set.names?.length ?? "-"}</td>
          <td>${rate(set.points.find((/** @type {any} */ p) => p.phase === "random_policy"))}</td><td>${rate(ofPolicy.length > 1 ? ofPolicy[0] : null)}</td><td>${rate(ofPolicy.length > 2 ? ofPolicy.at(-2) : null)}</td><td>${rate(ofPolicy.at(-1))}</td></tr>`;
      })}</tbody></table></div>
  </${Panel}>`;
}

/** Levels of a set, or of all. @param {{ run: string, data: any, set: string, withLevels: string[] }} props */
function Levels({ run, data, set, withLevels }) {
  const { query } = useAddress();
  const isAll = set === ALL;
  const sets = isAll ? withLevels : [set];
  const sort = Object.hasOwn(SORTS, query.get("sort") ?? "") ? query.get("sort") ?? "" : "least";
  const filter = query.get("filter") ?? "";
  const open = query.get("level");
  const evaluations = sets.map((name) => data.sets[name].points.length).join(" ");
  const features = useRequest(async () => {
    // One after another: the engine worker builds one set at a time.
    /** @type {Record<string, any>} */
    const found = {};
    for (const name of sets) {
      found[name] = await get(`runs/${encodeURIComponent(run)}/evaluations/features`, { set: name }).catch((error) => ({ problem: String(error.message ?? error) }));
    }
    return found;
  }, [run, set, evaluations]);
  const known = features.data ?? {};
  const columns = useMemo(() => columnsOf(data, sets), [data, set]);
  const rows = useMemo(() => rowsOf(data, sets, columns, known), [data, set, columns, features.data]);
  const { rows: matching, problem } = useMemo(() => filtered(rows, filter), [rows, filter]);
  const shown = useMemo(() => sorted(matching, sort), [matching, sort]);
  const [checked, setChecked] = useState(/** @type {Set<string>} */ (new Set()));
  const chosen = useMemo(() => rows.filter((row) => checked.has(row.key)), [rows, checked]);
  const against = changeOfSort(sort) === "best" ? "best" : "first";
  const values = useMemo(() => new Map(rows.map((row) => [row.key, row.cells.map((cell) => cell?.rate ?? null)])), [rows]);
  const matrixRows = useMemo(() => shown.map((row) => ({
    key: row.key,
    name: isAll ? `${row.set} ${row.name}` : row.name,
    values: values.get(row.key) ?? [],
    numbers: [countsCell(row.now), countsCell(row.before), changeCell(row.changes?.last), changeCell(row.changes?.[against])],
    isChecked: checked.has(row.key),
  })), [shown, checked, against, values]);
  const byKey = useMemo(() => new Map(rows.map((row) => [row.key, row])), [rows]);
  const opened = open === null ? null : byKey.get(open) ?? rows.find((row) => open === `${row.set}/${row.name}` || open === row.name) ?? null;
  const check = (/** @type {{ key: string }} */ { key }) => {
    const next = new Set(checked);
    if (!next.delete(key)) next.add(key);
    setChecked(next);
  };
  const problemOf = (/** @type {string} */ name) => known[name]?.problem ?? features.error;
  const attempts = [...new Set(rows.map((row) => row.now?.attempts).filter(Boolean))].join(" or ");
  const title = `${set}: levels over evaluations`;
  const csv = () => [["set", "level", "phase", "update", "solved", "attempts"],
    ...shown.flatMap((row) => row.cells.flatMap((cell, k) => (cell ? [[row.set, row.name, columns[k].phase, columns[k].update, cell.solved, cell.attempts]] : [])))];
  const png = () => matrixPicture(matrixRows, columns.map((column) => column.label)).toBlob((blob) => blob && download(`${`${run} ${title}`.replace(/\W+/g, "_")}.png`, blob));
  const numbers = [
    { title: "now", help: "newest evaluation: solved of attempts, 95 % interval", width: 164, stays: true },
    { title: "before training", help: "first evaluation of the policy", width: 164, stays: true },
    { title: "since previous", help: "points against the evaluation before, 95 % interval", width: 116 },
    { title: NAMES_OF_CHANGES[against], help: against === "best" ? "points against the best evaluation of each level, which is partly luck: the more evaluations, the more" : "points against the first evaluation, 95 % interval", width: 116 },
  ];
  const describe = (/** @type {{ key: string, name: string }} */ { key, name }, /** @type {number} */ k) => `${name}, ${columns[k].label}: ${countsText(byKey.get(key)?.cells[k] ?? null)}`;
  return html`<div class="row bar evaluation-bar">
      ${withLevels.length > 1 ? html`<label>set <select onChange=${(/** @type {any} */ e) => setQuery({ set: e.target.value, level: null })}>${[...withLevels, ALL].map((name) => html`<option key=${name} value=${name} selected=${name === set}>${name}</option>`)}</select></label>` : null}
      <label>order <select onChange=${(/** @type {any} */ e) => setQuery({ sort: e.target.value })}>${Object.entries(SORTS).map(([name, words]) => html`<option key=${name} value=${name} selected=${name === sort}>${words}</option>`)}</select></label>
      <${Filter} value=${filter} features=${Object.keys(rows.find((row) => row.features)?.features ?? {})} />
      <span class="soft" role="status">${shown.length} of ${rows.length} levels</span>
    </div>
    ${problem ? html`<p class="bad">${problem}</p>` : null}
    ${open !== null && !opened ? html`<p class="bad">no level ${open} in ${set}</p>` : null}
    <div class=${opened ? "with-drawer" : ""}>
      <${Panel} title=${title} help=${`${attempts} ${attempts === "1" ? "attempt" : "attempts"} at each level; a column an evaluation (update); arrow keys, Enter, space`} rows=${csv} name=${`${run} ${title}`} wide=${true} picture=${false} buttons=${html`<button class="png" onClick=${png} title="the picture as PNG">PNG</button>`}>
        <${LevelMatrix} rows=${matrixRows} numbers=${numbers} columns=${columns.map((column) => column.label)} first=${["before"]} chosen=${opened?.key ?? null}
          open=${(/** @type {{ key: string }} */ row) => setQuery({ level: row.key })} close=${() => setQuery({ level: null })} check=${check} describe=${describe} label=${`solved attempts of the levels of ${set}; arrow keys move, Enter opens, space chooses`} />
        <${Choice} shown=${shown} chosen=${chosen} choose=${(/** @type {string[]} */ keys) => setChecked(new Set(keys))} />
        ${chosen.length ? html`<${TrainOnLevels} run=${run} chosen=${chosen} total=${(/** @type {string} */ name) => data.sets[name].names.length} />` : null}
      </${Panel}>
      ${opened ? html`<${EvaluatedLevel} key=${opened.key} run=${run} row=${opened} columns=${columns} size=${known[opened.set]?.size ?? null} problem=${problemOf(opened.set)} />` : null}
    </div>
    ${isAll ? html`<p class="missing">Choose one set to see what its failing levels have in common.</p>` : html`<${FailingLevels} run=${run} set=${set} rows=${rows} features=${known[set]?.groupings ? known[set] : null} problem=${problemOf(set)} />`}`;
}

/** Buttons that choose several levels. @param {{ shown: import("./evaluated_levels.js").Row[], chosen: unknown[], choose: (keys: string[]) => void }} props */
function Choice({ shown, chosen, choose }) {
  const [count, setCount] = useState(WORST);
  const keys = shown.map((row) => row.key);
  return html`<div class="row choosing"><span>${chosen.length} chosen</span>
    <span><button onClick=${() => choose(keys.slice(0, count))}>choose the first</button> <input type="number" min="1" max=${keys.length} value=${count} aria-label="number of levels" onInput=${(/** @type {any} */ e) => setCount(Math.max(1, Math.round(Number(e.target.value))))} /></span>
    <button onClick=${() => choose(keys)}>choose all ${keys.length} shown</button>
    <button class=${chosen.length ? "" : "off"} onClick=${() => choose([])}>none</button></div>`;
}

/** @param {{ value: string, features: string[] }} props */
function Filter({ value, features }) {
  const [text, setText] = useState(value);
  useEffect(() => setText(value), [value]);
  const apply = () => setQuery({ filter: text });
  return html`<label>filter <input value=${text} placeholder="hop joints>=1 now<0.5" title=${`parts of names, and conditions on ${["now", "before", "lost", ...features].join(", ")}`} onInput=${(/** @type {any} */ e) => setText(e.target.value)}
    onChange=${apply} onKeyDown=${(/** @type {any} */ e) => e.key === "Enter" && apply()} /></label>`;
}

/** @param {import("./evaluated_levels.js").Counts | null} counts */
function countsCell(counts) {
  return counts ? html`<b>${Math.round(100 * counts.rate)} %</b> ${counts.solved} of ${counts.attempts} <small>${Math.round(100 * counts.low)} to ${Math.round(100 * counts.high)}</small>` : html`<span class="soft">-</span>`;
}

/** @param {import("./evaluated_levels.js").Change | undefined} change */
function changeCell(change) {
  if (!change) return html`<span class="soft">-</span>`;
  const word = change.high < 0 ? "bad" : change.low > 0 ? "good" : "soft";
  return html`<b class=${word}>${points(change.value)}</b> <small>${points(change.low)} to ${points(change.high)}</small>`;
}
