// 64 attempts of a level by a policy: p with its interval, and learnability.
import { channel } from "../base/channel.js";
import { percent } from "../base/format.js";
import { html, useRef, useState } from "../base/html.js";
import { Term } from "../base/term.js";
import { playerWords, PolicyChoice, policyOf } from "./play_bar.js";

const ATTEMPTS = 64;
const BUNDLED = "generalist"; // the policy that `teach it` begins with, too

/**
 * `given`: the level as the engine worker calls it; one of a run is played in the environment of that run. `subject`: what
 * changes when it becomes another level; `player`: who plays it otherwise, whose attempts are proposed unless it is a person.
 * @param {{ given: any, subject: any, engine: any, player: string }} props
 */
export function AttemptsPanel({ given, subject, engine, player }) {
  const [chosen, setPolicy] = useState("");
  const policy = chosen || (player !== "keys" ? player : engine.pretrained.includes(BUNDLED) ? `checkpoint:${BUNDLED}` : "random");
  const [state, setState] = useState(/** @type {any} */ (null));
  const request = useRef("");
  const start = async () => {
    const env = "run" in given ? { run: given.run } : undefined;
    setState({ progress: "starting ..." });
    const progress = (/** @type {any} */ message) => setState({ progress: message.stage === "playing" ? `${message.done ?? 0} of ${message.total ?? ATTEMPTS} ended` : `${message.stage} ...` });
    try {
      const result = await channel.request("attempts", { level: given, policy: policyOf(policy), env, attempts: ATTEMPTS, seed: 0 }, progress, (id) => { request.current = id; });
      setState({ result, subject, player: policy });
    } catch (error) {
      setState({ error: error instanceof Error ? error.message : String(error) });
    }
  };
  const { result } = state ?? {};
  return html`<section class="panel" data-panel="attempts"><header><h3><${Term} name="learnability">Learnability</${Term}></h3><span class="help">${ATTEMPTS} attempts</span></header>
    <div class="row small"><${PolicyChoice} value=${policy} choose=${setPolicy} engine=${engine} people=${false} label="policy of the attempts" />
      ${state?.progress ? html`<button onClick=${() => channel.send({ type: "cancel", id: request.current })}>cancel</button>` : html`<button onClick=${start}>play ${ATTEMPTS} times</button>`}</div>
    ${state?.progress ? html`<p class="soft" role="status">${state.progress}</p>` : null}
    ${state?.error ? html`<p class="bad">${state.error}</p>` : null}
    ${result ? html`<p role="status">${playerWords(state.player)}: p ${percent(result.p)} (${result.solved} of ${result.attempts}), 95 % ${percent(result.low)} to ${percent(result.high)} · learnability <b>${result.learnability?.toFixed(3) ?? "-"}</b>
      <span class="soft"> · ${result.failed} failed, ${result.timed_out} ran out of time · mean length ${result.mean_length.toFixed(0)} steps · ${result.seconds.toFixed(1)} s${state.subject === subject ? "" : " · the level was changed since"}</span></p>` : null}
  </section>`;
}
