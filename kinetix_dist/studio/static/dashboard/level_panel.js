// One level next to a list of levels: played in place, facts, its file, the editor, 64 attempts, and its history below.
import { addressOf, setQuery } from "../base/address.js";
import { get, useRequest } from "../base/api.js";
import { html } from "../base/html.js";
import { AttemptsPanel } from "../play/attempts.js";
import { PlayStage } from "../play/stage.js";
import { Notes } from "./parts.js";

const PICTURE = 340; // pixels

/** Features of a level in words: "3 shapes, 1 joint". @param {Record<string, number>} features counts by their plural names */
export function featureText(features) {
  return Object.entries(features).map(([name, count]) => `${count} ${(count === 1 ? name.replace(/s$/, "") : name).replace("_", " ")}`).join(", ");
}

/**
 * `given`: the level as the engine worker calls it; `subject`: a name that no other level of the page has; `document`: the
 * address of its file below api/; `missing`: why there is no picture; `children`: the history.
 * @param {{ title: string, run: string, given: any, subject: string, label: string, picture: any, missing: string,
 *   facts: [string, any][], features: string, document: string, children?: any }} props
 */
export function LevelPanel({ title, run, given, subject, label, picture, missing, facts, features, document, children }) {
  const engine = useRequest(() => (picture ? get("engine") : Promise.resolve(null)), [Boolean(picture)]);
  return html`<aside class="panel drawer" data-panel="level"><header><h3 title=${title}>${title}</h3>
      <span class="buttons"><button onClick=${() => setQuery({ level: null })} aria-label="close">✕</button></span></header>
    <${Notes} notes=${engine.error ? [engine.error] : []} />
    ${picture && engine.data ? html`<${PlayStage} key=${subject} given=${given} run=${run} engine=${engine.data} still=${picture} size=${PICTURE} label=${label} />` : html`<p class="missing">${picture ? "the engine starts ..." : missing}</p>`}
    <dl class="facts">${facts.map(([fact, value]) => html`<div key=${fact}><dt>${fact}</dt><dd>${value}</dd></div>`)}</dl>
    <p class="soft">${features}</p>
    ${picture ? html`<a class="button" href=${addressOf(["edit"], new URLSearchParams({ from: document }))}>edit</a> <a class="button" href=${`api/${document}`} download>download as a level file</a>` : null}
    ${picture && engine.data ? html`<${AttemptsPanel} key=${`attempts ${subject}`} given=${given} subject=${subject} engine=${engine.data} player=${`run:${run}`} />` : null}
    ${children}
  </aside>`;
}
