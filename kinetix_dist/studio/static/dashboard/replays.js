// Recorded rollouts of a run: a list, and the player for the chosen one.
import { setQuery, useAddress } from "../base/address.js";
import { ApiError, get, useRequest } from "../base/api.js";
import { date, short } from "../base/format.js";
import { html, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { getPalette } from "../world/picture.js";
import { decodeRollout, Player } from "../world/player.js";
import { Notes } from "./parts.js";
import { useRunChanges } from "./run_changes.js";

/** @param {{ run: string }} props */
export function ReplaysPage({ run }) {
  const { query } = useAddress();
  const changes = useRunChanges(run);
  const base = `runs/${encodeURIComponent(run)}/recordings`;
  const { data, error } = useRequest(() => get(base), [run, changes]);
  const palette = useRequest(getPalette, []);
  const chosen = query.get("rollout") ?? first(data);
  const rollout = useRequest(() => (chosen ? load(`api/${base}/${chosen}`) : Promise.resolve(null)), [run, chosen]);
  const [file, index] = (chosen ?? "").split("/");
  const entry = data?.files.find((/** @type {any} */ one) => encodeURIComponent(one.file) === file);
  const notes = [error, chosen ? rollout.error : null, ...(data?.files ?? []).flatMap((/** @type {any} */ one) => one.problems)].filter(Boolean);
  return html`<main>
    <${Notes} notes=${notes} />
    ${data || error ? null : html`<p class="missing">reading recordings; the engine worker starts ...</p>`}
    ${data && !data.files.length ? html`<p class="missing">No rollouts so far (recordings/*.mcap). They are recorded after training, and every recording.every updates.</p>` : null}
    <div class="replays">
      ${rollout.data && palette.data ? html`<section class="panel" data-panel="player"><header><h3>${rollout.data.name}</h3>
          <span class="help">${rollout.data.policy_version < 0 ? "random actions" : `policy of update ${rollout.data.policy_version}`}, seed ${rollout.data.seed}; states as they were recorded</span></header>
        <${Player} key=${chosen} rollout=${rollout.data} palette=${palette.data} />
        ${entry ? html`<p class="soft">On a terminal: <code>kinetix-dist replay ${entry.path} --index ${index} --view</code></p>` : null}</section>` : null}
      <div class="scroll">${(data?.files ?? []).map((/** @type {any} */ one) => html`<table key=${one.file}><thead><tr><th colspan="5">${one.file}, ${date(one.modified)}, ${short(one.bytes)}B</th></tr></thead><tbody>
        ${one.rollouts.map((/** @type {any} */ r) => {
          const name = `${encodeURIComponent(one.file)}/${r.index}`;
          return html`<tr key=${name} class=${name === chosen ? "chosen" : ""}><td><button class="link" onClick=${() => setQuery({ rollout: name })}>${r.index}. ${r.name}</button></td>
            <td>${r.outcome === "solved" ? "✓ " : ""}${r.outcome}</td><td class="number">${count(r.num_steps, "step")}</td><td class="number">return ${r.return.toFixed(2)}</td>
            <td>${r.policy_version < 0 ? "random" : `update ${r.policy_version}`}</td></tr>`;
        })}</tbody></table>`)}</div>
    </div>
    ${rollout.data ? html`<${Rerun} key=${`rerun ${chosen}`} address=${`${base}/${chosen}`} />` : null}
  </main>`;
}

/** rerun's own viewer in the page, once it is requested; and the file that it shows. @param {{ address: string }} props */
function Rerun({ address }) {
  const [state, setState] = useState(/** @type {{ viewer?: string, rrd?: string, error?: string, isMaking?: boolean }} */ ({}));
  const open = async () => {
    setState({ isMaking: true });
    try {
      setState(await get(`${address}/rrd`));
    } catch (error) {
      setState({ error: String(/** @type {Error} */ (error).message) });
    }
  };
  if (state.viewer && state.rrd) {
    const query = new URLSearchParams({ url: new URL(state.rrd, location.href).href.split("#")[0], renderer: "webgl" });
    return html`<section class="panel wide" data-panel="rerun"><header><h3>rerun</h3><span class="buttons"><a class="button" href=${state.rrd} download>download .rrd</a></span></header>
      <iframe class="rerun" title="rerun" src=${`${state.viewer}?${query}`}></iframe></section>`;
  }
  return html`<div class="row"><button onClick=${open} disabled=${state.isMaking}>${state.isMaking ? "making the .rrd ..." : "show in rerun"}</button>
    ${state.error ? html`<span class="bad">${state.error}</span>` : null}</div>`;
}

/** The newest rollout. @param {any} data @returns {string | null} */
function first(data) {
  const file = data?.files.find((/** @type {any} */ one) => one.rollouts.length);
  return file ? `${encodeURIComponent(file.file)}/${file.rollouts[0].index}` : null;
}

/** @param {string} address */
async function load(address) {
  const answer = await fetch(address);
  if (!answer.ok) throw new ApiError((await answer.json().catch(() => ({}))).error ?? `the server answered ${answer.status}`);
  return decodeRollout(await answer.arrayBuffer());
}
