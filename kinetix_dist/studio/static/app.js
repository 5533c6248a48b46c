// The frame of all pages: navigation, connection, theme; which page is shown follows from the address.
import { addressOf, useAddress } from "./base/address.js";
import { channel, useConnection } from "./base/channel.js";
import { html, render } from "./base/html.js";
import { usePanelOfAddress } from "./base/panel_link.js";
import { restoreTheme, toggleTheme } from "./base/theme.js";
import { ComparePage } from "./dashboard/compare.js";
import { CurriculumPage } from "./dashboard/curriculum.js";
import { EvaluationPage } from "./dashboard/evaluation.js";
import { LevelsPage } from "./dashboard/levels.js";
import { OverviewPage } from "./dashboard/overview.js";
import { ReplaysPage } from "./dashboard/replays.js";
import { RunsPage } from "./dashboard/runs.js";
import { EditorPage } from "./editor/page.js";

/** Pages of a run, in the order of the navigation. @type {Record<string, [string, any]>} */
const RUN_PAGES = {
  overview: ["Overview", OverviewPage],
  curriculum: ["Curriculum", CurriculumPage],
  levels: ["Levels", LevelsPage],
  evaluation: ["Evaluation", EvaluationPage],
  replays: ["Replays", ReplaysPage],
};

function App() {
  const address = useAddress();
  const { parts, query } = address;
  usePanelOfAddress(address);
  const [area = "runs", id, page = "overview"] = parts;
  const run = area === "run" ? id : null;
  return html`<nav>
      <a class="name" href="#/runs">kinetix-dist</a>
      <a href="#/runs" aria-current=${area === "runs" ? "page" : null}>Runs</a>
      <a href="#/compare" aria-current=${area === "compare" ? "page" : null}>Compare</a>
      <a href="#/edit" aria-current=${area === "edit" ? "page" : null}>Editor</a>
      ${run ? html`<span class="of" title=${run}>${run}</span>
        ${Object.entries(RUN_PAGES).map(([key, [label]]) => html`<a key=${key} href=${addressOf(["run", run, key], shared(query))}
          aria-current=${page === key ? "page" : null}>${label}</a>`)}` : null}
      <span class="space"></span>
      <${Connection} />
      <button onClick=${toggleTheme} title="dark or light" aria-label="dark or light">◐</button>
    </nav>
    <${Page} area=${area} run=${run} page=${page} />`;
}

/** Shared part of the addresses of a run's pages. @param {URLSearchParams} query */
function shared(query) {
  const shared = new URLSearchParams();
  for (const name of ["x", "smooth", "from", "to"]) if (query.get(name)) shared.set(name, query.get(name) ?? "");
  return shared;
}

/** @param {{ area: string, run: string | null, page: string }} props */
function Page({ area, run, page }) {
  if (area === "runs") return html`<${RunsPage} />`;
  if (area === "compare") return html`<${ComparePage} />`;
  if (area === "edit") return html`<${EditorPage} />`;
  if (run && page in RUN_PAGES) {
    document.title = `${run} · ${RUN_PAGES[page][0]}`;
    return html`<${RUN_PAGES[page][1]} key=${`${run} ${page}`} run=${run} />`;
  }
  return html`<main><p class="missing">There is no page of that address. <a href="#/runs">All runs</a></p></main>`;
}

function Connection() {
  const state = useConnection();
  return state === "connected" ? null : html`<span class="bad" role="status">${state}</span>`;
}

restoreTheme();
channel.connect();
render(html`<${App} />`, /** @type {Element} */ (document.getElementById("app")));
