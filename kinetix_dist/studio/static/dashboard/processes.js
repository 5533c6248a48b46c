// Processes of a run with memory and idle share, which of them were lost, idle shares over time.
import { get, useRequest } from "../base/api.js";
import { percent, short } from "../base/format.js";
import { html } from "../base/html.js";
import { HeatMap } from "../charts/heat_map.js";
import { Panel } from "../charts/panel.js";
import { Notes } from "./parts.js";

const MAX_ROWS = 64; // of the picture; the table and the CSV have all

/** @param {{ run: string, changes: number }} props */
export function Processes({ run, changes }) {
  const { data, error } = useRequest(() => get(`runs/${encodeURIComponent(run)}/processes`), [run, changes]);
  if (!data) return html`<${Notes} notes=${error ? [error] : []} />`;
  const rows = () => [["name", "role", "host", "pid", "device", "resident_bytes", "pool_bytes", "gpu_share", "idle", "doing", "lost", "seen_at", "is_there"],
    ...data.processes.map((/** @type {any} */ p) => [p.name, p.role, p.host, p.pid, p.device, p.resident_bytes, p.pool_bytes, p.gpu_share, p.idle, p.doing, p.lost, p.seen_at, p.is_there])];
  const help = data.time ? `at update ${data.update}, ${data.time}; idle: share of time in no call, mean over the run; lost: replaced after a failure` : "";
  return html`<${Panel} title="Processes" help=${help} rows=${rows} name=${`${run} processes`} wide=${true} picture=${false}
    missing=${data.processes.length ? null : "This run has no processes.jsonl: it is of an older version, or has not written a row yet."}>
    <${Notes} notes=${data.problems} />
    <div class="scroll short"><table><thead><tr><th>process</th><th>host</th><th class="number">pid</th><th>device</th><th class="number">memory</th><th class="number">of the GPU</th><th class="number">idle</th><th>doing</th><th>lost</th></tr></thead>
      <tbody>${data.processes.map((/** @type {any} */ p) => html`<tr key=${p.name} class=${p.is_there ? "" : "soft"}><td>${p.name}${p.is_there ? "" : `, last seen at update ${p.seen_at}`}</td><td>${p.host}</td><td class="number">${p.pid}</td>
        <td>${p.device ?? "-"}</td><td class="number">${short(p.resident_bytes)}B</td><td class="number">${percent(p.gpu_share)}</td><td class="number">${percent(p.idle)}</td><td>${p.doing ?? ""}</td>
        <td class=${p.lost ? "bad" : ""} title=${p.error ?? ""}>${p.lost}${p.error ? ` (${p.error})` : ""}</td></tr>`)}</tbody></table></div>
    <${Idle} data=${data} />
  </${Panel}>`;
}

/** @param {{ data: any }} props */
function Idle({ data }) {
  const names = Object.keys(data.idle).slice(0, MAX_ROWS);
  if (!names.length) return html`<p class="soft">No process reports its idle time: training in one process, or its first minute.</p>`;
  const texts = names.map((name) => data.idle[name].map((/** @type {number | null} */ share, /** @type {number} */ k) => `${name} up to update ${data.updates[k]}: idle ${percent(share)} of the time`));
  return html`<${HeatMap} rows=${names} columns=${data.updates.map(String)} values=${names.map((name) => data.idle[name])} texts=${texts} labelWidth=${90} cellWidth=${data.updates.length > 20 ? undefined : 40} describe="idle share of each process over updates" />`;
}
