// View shared by all charts of a run: the axis, smoothing and zoom, stored in the address.
import { setQuery, useAddress } from "../base/address.js";
import { html } from "../base/html.js";

export const AXES = { env_steps: "env steps", updates: "updates", seconds: "training seconds", time: "date" };

/** @returns {{ axis: string, smooth: number, from: number | null, to: number | null, log: Set<string> }} */
export function useView() {
  const { query } = useAddress();
  const number = (/** @type {string} */ name) => (query.get(name) ? Number(query.get(name)) : null);
  const axis = query.get("x") ?? "env_steps";
  return {
    axis: axis in AXES ? axis : "env_steps",
    smooth: Math.min(Math.max(number("smooth") ?? 0, 0), 0.99),
    from: number("from"),
    to: number("to"),
    log: new Set((query.get("log") ?? "").split(",").filter(Boolean)),
  };
}

/** @param {number | null} from @param {number | null} to */
export function zoom(from, to) {
  setQuery({ from: from === null ? null : String(from), to: to === null ? null : String(to) });
}

/** @param {{ view: ReturnType<typeof useView>, children?: any }} props */
export function ViewBar({ view, children }) {
  const { axis, smooth } = view;
  const isZoomed = view.from !== null || view.to !== null;
  return html`<div class="row bar">
    <label>axis <select value=${axis} onChange=${(/** @type {any} */ e) => setQuery({ x: e.target.value, from: null, to: null })}>
      ${Object.entries(AXES).map(([key, label]) => html`<option value=${key} selected=${key === axis}>${label}</option>`)}
    </select></label>
    <label>smoothing <input type="range" min="0" max="0.98" step="0.02" value=${smooth}
      onInput=${(/** @type {any} */ e) => setQuery({ smooth: e.target.value === "0" ? null : e.target.value })} />
      <span class="soft">${smooth.toFixed(2)}</span></label>
    <button class=${isZoomed ? "" : "off"} onClick=${() => zoom(null, null)} title="or double-click a chart">all of it</button>
    <span class="soft">drag over a chart to zoom</span>
    ${children}
  </div>`;
}

/** @param {{ name: string, log: Set<string> }} props */
export function LogButton({ name, log }) {
  const isOn = log.has(name);
  const next = new Set(log);
  if (isOn) next.delete(name);
  else next.add(name);
  return html`<button aria-pressed=${isOn} onClick=${() => setQuery({ log: [...next].join(",") })} title="logarithmic">log</button>`;
}
