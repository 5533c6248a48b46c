// Chosen levels of evaluation sets as a command that trains on them, and as level files.
import { get, useRequest } from "../base/api.js";
import { html } from "../base/html.js";
import { Command } from "./command.js";

/** @param {{ run: string, chosen: import("./evaluated_levels.js").Row[], total: (set: string) => number }} props
 * total: number of levels of a set */
export function TrainOnLevels({ run, chosen, total }) {
  const sets = [...new Set(chosen.map((row) => row.set))];
  return html`<div data-panel="train on these">${sets.map((set) => html`<${OfSet} key=${set} run=${run} set=${set} indices=${chosen.filter((row) => row.set === set).map((row) => row.index).sort((a, b) => a - b)} total=${total(set)} />`)}</div>`;
}

/** @param {{ run: string, set: string, indices: number[], total: number }} props */
function OfSet({ run, set, indices, total }) {
  const base = `runs/${encodeURIComponent(run)}/evaluations`;
  const named = indices.length === total ? "" : indices.join(","); // left out: the whole set
  const { data, error } = useRequest(() => get(`${base}/finetune`, { set, indices: named }), [run, set, named]);
  if (!data) return html`<p class=${error ? "bad" : "soft"}>${error ?? "..."}</p>`;
  const archive = `api/${base}/archive?${new URLSearchParams({ set, ...(named ? { indices: named } : {}) })}`;
  return html`<section class="train-on">
    <h3>Train on ${indices.length === 1 ? "this level" : `these ${indices.length} levels`} of ${set}</h3>
    <${Command} text=${data.lines.join("\n")} />
    <p>${data.archive ? html`First download <a class="button" href=${archive} download>${data.archive}</a> and run this where it is.` : html`The whole set has a name; its files are in <a class="button" href=${archive} download>an archive</a> too.`}
      ${data.has_checkpoint ? " It goes on from the newest checkpoint of this run." : " This run has no checkpoint, so training starts from scratch."}
      <span class="soft"> A policy that has trained on levels of ${set} is not measured by ${set} any more: choose another set to evaluate it.</span></p>
  </section>`;
}
