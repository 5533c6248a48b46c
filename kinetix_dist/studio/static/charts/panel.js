// The frame of every chart and table: title, what it means, CSV and PNG of what is shown.
import { csv, download } from "../base/format.js";
import { html, useRef } from "../base/html.js";
import { Terms } from "../base/term.js";
import { colour } from "../base/theme.js";
import { Explanation } from "./explanation.js";

/**
 * `rows` makes the table behind the picture, its first row the header. `missing`: a line instead of a picture, where a
 * run lacks what the panel shows. `metrics`: that it shows, by which links find it. The picture is the first canvas in the panel; `picture` false: there is none.
 * @param {{ title: string, help?: any, missing?: string | null, rows?: () => (string | number | null)[][],
 *   buttons?: any, wide?: boolean, metrics?: string[], picture?: boolean, name?: string, children?: any }} props
 */
export function Panel({ title, help, missing, rows, buttons, wide, picture = true, name, metrics, children }) {
  const element = useRef(/** @type {HTMLElement | null} */ (null));
  const fileName = (name ?? title).replace(/\W+/g, "_");
  const saveCsv = () => rows && download(`${fileName}.csv`, csv(rows()));
  const savePng = () => {
    const canvas = element.current?.querySelector("canvas");
    if (canvas) pngOf(canvas, title).toBlob((blob) => blob && download(`${fileName}.png`, blob));
  };
  return html`<section class=${`panel${wide ? " wide" : ""}`} ref=${element} data-panel=${title} data-metrics=${metrics?.join(" ")}>
    <header>
      <h3><${Terms} text=${title} /></h3>
      <span class="buttons">
        ${missing ? null : buttons}
        ${rows && !missing ? html`<button onClick=${saveCsv} title="the numbers as CSV">CSV</button>` : null}
        ${missing || !picture ? null : html`<button class="png" onClick=${savePng} title="the picture as PNG">PNG</button>`}
      </span>
    </header>
    ${help ? html`<${Explanation} text=${help} />` : null}
    ${missing ? html`<p class="missing">${missing}</p>` : children}
  </section>`;
}

/** A canvas with its title above, on the background of the page. @param {HTMLCanvasElement} source @param {string} title */
function pngOf(source, title) {
  const scale = devicePixelRatio || 1;
  const canvas = document.createElement("canvas");
  canvas.width = source.width;
  canvas.height = source.height + 24 * scale;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.fillStyle = colour("panel");
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.fillStyle = colour("ink");
  context.font = `${14 * scale}px sans-serif`;
  context.fillText(title, 8 * scale, 17 * scale);
  context.drawImage(source, 0, 24 * scale);
  return canvas;
}
