// "teach it" trains a policy on the level in the background, "solve it" searches for a solution; both are played here.
import { addressOf } from "../base/address.js";
import { duration, percent } from "../base/format.js";
import { html, useEffect, useRef, useState } from "../base/html.js";
import { count } from "../base/language.js";
import { documentText } from "./document.js";

const POLL_MS = 1000;
const ADDRESS = "api/teaching";

/** @typedef {{ solved: number, attempts: number, rate: number, low: number, high: number }} Rate */
/** @typedef {{ number: number, kind: "teach" | "solve", seconds: number, state: string, stage: string, elapsed: number, command: string,
 *   document: any, progress: any, text: string, advice: string, before: Rate | null, after: Rate | null, solves_already: boolean, learned: boolean,
 *   proof: { steps: number, method: string, robustness: number | null, actions: number[][] } | null, run: string | null,
 *   files: Record<string, string> }} Job */

/** @param {string} method @param {any} [content] @returns {Promise<{ results: string, seconds: number[], job: Job | null }>} */
async function call(method, content) {
  const answer = await fetch(ADDRESS, { method, ...(content ? { body: JSON.stringify(content) } : {}) }).catch(() => null);
  if (!answer) throw new Error("the server does not answer");
  const reply = await answer.json();
  if (!answer.ok) throw new Error(reply.error);
  return reply;
}

/** @param {{ editor: import("./state.js").Editor, play: import("../play/play.js").Play }} props */
export function TeachPanel({ editor, play }) {
  const [about, setAbout] = useState(/** @type {{ results: string, seconds: number[], job: Job | null } | null} */ (null));
  const [seconds, setSeconds] = useState(120);
  const [problem, setProblem] = useState("");
  const [isBusy, setBusy] = useState(false); // a request is under way
  const own = useRef(0); // number of the job that this page began and has not played yet
  const job = about?.job ?? null;
  const isRunning = job?.state === "running";
  const isChecking = isBusy && about !== null && !isRunning; // before a job is begun

  const request = async (/** @type {() => Promise<any>} */ act) => {
    setBusy(true);
    try {
      setAbout(await act());
      setProblem("");
    } catch (error) {
      setProblem(error instanceof Error ? error.message : String(error));
    }
    setBusy(false);
  };
  const begin = (/** @type {string} */ kind) => request(async () => {
    const reply = await call("POST", { kind, document: editor.settled, seconds });
    own.current = reply.job?.number ?? 0;
    return reply;
  });
  useEffect(() => void request(() => call("GET")), []);
  useEffect(() => {
    if (!isRunning) return undefined;
    const timer = setInterval(() => call("GET").then((reply) => { setAbout(reply); setProblem(""); }, (error) => setProblem(error.message)), POLL_MS);
    return () => clearInterval(timer);
  }, [isRunning]);
  const isSame = job !== null && documentText(job.document) === documentText(editor.settled);
  useEffect(() => {
    if (!job || isRunning || own.current !== job.number) return;
    own.current = 0;
    if (isSame && !play.isOpen && policyOf(job)) void play.open({ document: job.document }, policyOf(job));
  }, [job?.number, isRunning]);

  return html`<section class="panel" data-panel="teach"><header><h3>Teach it, or solve it</h3><span class="help">in the background, on the CPU</span></header>
    <div class="row small">
      <button disabled=${isRunning || isBusy} onClick=${() => begin("teach")} title="searches for a solution, and trains the bundled policy on it">teach it</button>
      <button disabled=${isRunning || isBusy} onClick=${() => begin("solve")} title="searches for actions that solve this level">solve it</button>
      <label>for <select aria-label="time to teach or to search" disabled=${isRunning} onChange=${(/** @type {any} */ e) => setSeconds(Number(e.target.value))}>
        ${(about?.seconds ?? [60, 120, 300]).map((value) => html`<option key=${value} value=${value} selected=${value === seconds}>${value / 60} min</option>`)}</select></label>
      ${isRunning ? html`<button onClick=${() => request(() => call("DELETE"))}>cancel</button>` : null}
    </div>
    ${problem ? html`<p class="bad" role="alert">${problem}</p>` : null}
    ${isChecking ? html`<p class="soft" role="status">the level is checked ...</p>` : null}
    ${isChecking ? null : job ? html`<${JobState} job=${job} isSame=${isSame} />` : html`<p class="soft">Level, policy and a proof are stored in ${about?.results ?? "..."}.</p>`}
    ${job && !isRunning && !isChecking ? html`<div class="row small">
      ${job.run ? html`<button onClick=${() => play.open({ document: job.document }, { run: job.run })}>▶ play ${job.learned ? "what was learned" : "the trained policy"}</button>` : null}
      ${job.solves_already ? html`<button onClick=${() => play.open({ document: job.document }, policyOf(job))}>▶ play the policy</button>` : null}
      ${job.proof ? html`<button onClick=${() => play.open({ document: job.document }, { actions: job.proof?.actions })}>▶ play the proof</button>` : null}
      ${job.run ? html`<a class="button" href=${addressOf(["run", job.run, "overview"])}>its run</a>` : null}
      ${isSame ? null : html`<button onClick=${() => editor.open(job.document)} title="undo brings back the level that is shown now">open its level</button>`}</div>` : null}
  </section>`;
}

/** @param {{ job: Job, isSame: boolean }} props */
function JobState({ job, isSame }) {
  const name = html`<b>${job.document.name}</b>${isSame ? "" : " (not the level that is shown)"}`;
  if (job.state === "running") {
    return html`<p role="status" data-state=${job.stage}>${name}: ${stageText(job)} <span class="soft">· ${duration(job.elapsed)} so far</span></p>
      ${job.before ? html`<p class="soft">before training: ${rateText(job.before)}</p>` : null}<${Command} job=${job} />`;
  }
  return html`<p role="status" class=${job.state === "failed" ? "bad" : ""} data-state=${job.state}>${name}: ${job.text}</p>
    ${job.before && job.after && !job.solves_already ? html`<p>before ${rateText(job.before)}; after ${rateText(job.after)}</p>` : null}
    ${job.solves_already && job.before ? html`<p>${rateText(job.before)}</p>` : null}
    ${job.proof ? html`<p class="soft">proof of ${job.proof.steps} steps, replayed by the engine${job.proof.robustness === null ? "" : `; also solves it from ${percent(job.proof.robustness)} of slightly different starts`}</p>` : null}
    ${job.state === "done" && job.after?.solved === 0 && !job.proof ? html`<p class="soft">no proof: the policy solved it in no attempt</p>` : null}
    ${job.advice ? html`<p>${job.advice}</p>` : null}
    <p class="soft">${Object.entries(job.files).map(([kind, path]) => html`<span key=${kind} class="path">${kind === "run" ? "run, with the policy" : kind}: <code>${path}</code><br /></span>`)}took ${duration(job.elapsed)}</p>
    <${Command} job=${job} />`;
}

/** The commands that do the same in a terminal. @param {{ job: Job }} props */
function Command({ job }) {
  return job.command ? html`<details><summary>in a terminal</summary><pre>${job.command}</pre>${job.kind === "teach" ? html`<p class="soft">A run is never written over: give --run another directory to repeat it.</p>` : null}</details>` : null;
}

/** @param {Job} job */
function stageText(job) {
  const { solve_rate: rate, attempts, seconds_left: left, updates, since } = job.progress;
  switch (job.stage) {
    case "searching": return `a solution is searched, ${duration(Date.now() / 1000 - since)} of ${duration(job.seconds)} and some to start`;
    case "trying": return `${foundText(job)} the untrained policy tries it 64 times ...`;
    case "imitating": return "the policy imitates the solution ...";
    case "compiling": return "programs of training are compiled, once for a size, up to a minute or two ...";
    case "training": return `trains: ${updates ? `${percent(rate)} of the last ${attempts} attempts solved after ${count(updates, "update")}, ${duration(left)} left` : "begins ..."}`;
    case "evaluating": return "64 attempts after training ...";
    case "proving": return `${job.solves_already ? "the policy solves it already" : "training is over"}; a proof by it is searched, and replayed ...`;
    default: return "is checked ...";
  }
}

/** @param {Job} job */
const foundText = (job) => job.proof ? `a solution of ${job.proof.steps} steps was found;` : "no solution was found, so it will train on the level alone;";

/** @param {Rate} rate */
const rateText = (rate) => `${rate.solved} of ${rate.attempts} attempts, ${percent(rate.rate)} (95 %: ${percent(rate.low)} to ${percent(rate.high)})`;

/** The policy that plays the result; null: there is none. @param {Job} job */
function policyOf(job) {
  if (job.state !== "done") return null;
  if (job.kind === "solve") return job.proof ? { actions: job.proof.actions } : null;
  if (job.proof && !job.learned && !job.solves_already) return { actions: job.proof.actions };
  return job.run ? { run: job.run } : { checkpoint: "generalist" };
}
