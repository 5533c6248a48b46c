// Icons of the tool bar: lines on a grid of 24, in the colour of the text. Joints look as editors of physics worlds draw
// them: a revolute joint is a pin with a turn about it, a weld two plates with a seam, a slider a block on a rail.
import { html } from "../base/html.js";

const ICONS = {
  select: html`<path d="M6 3l12 9-5.6 1 3.2 6.4-2.6 1.2-3.1-6.4L6 18z" fill="currentColor" stroke="none" />`,
  box: html`<rect x="4" y="6" width="16" height="12" />`,
  circle: html`<circle cx="12" cy="12" r="8" />`,
  triangle: html`<path d="M12 4l9 16H3z" />`,
  quadrilateral: html`<path d="M7 6h14l-4 12H3z" />`,
  revolute: html`<circle cx="12" cy="12" r="2.4" fill="currentColor" /><path d="M19.6 9a8 8 0 1 0 .4 3" /><path d="M20.6 4v5.2h-5.2" />`,
  fixed: html`<path d="M3 9h10v10H3zM13 5h8v10h-8" /><path d="M13 8.5v7" stroke-width="4.5" />`,
  prismatic: html`<path d="M2 12h20" /><rect x="8" y="7" width="8" height="10" fill="var(--panel)" /><path d="M5 9l-3 3 3 3M19 9l3 3-3 3" />`,
  thruster: html`<path d="M9 3h6l2 8H7z" /><path d="M9 14c0 4 3 4 3 8 0-4 3-4 3-8z" fill="currentColor" />`,
  pan: html`<path d="M12 3v18M3 12h18M9.5 5.5L12 3l2.5 2.5M9.5 18.5L12 21l2.5-2.5M5.5 9.5L3 12l2.5 2.5M18.5 9.5L21 12l-2.5 2.5" />`,
  undo: html`<path d="M9 5L4 10l5 5" /><path d="M4 10h10a6 6 0 0 1 0 12h-3" />`,
  redo: html`<path d="M15 5l5 5-5 5" /><path d="M20 10H10a6 6 0 0 0 0 12h3" />`,
  copy: html`<rect x="8" y="8" width="12" height="13" rx="1.5" /><path d="M16 8V4.500A1.5 1.5 0 0 0 14.5 3h-9A1.5 1.5 0 0 0 4 4.5v10A1.5 1.5 0 0 0 5.5 16H8" />`,
  paste: html`<path d="M9 5H5v16h14V5h-4" /><rect x="9" y="3" width="6" height="4" rx="1" /><path d="M8.5 12h7M8.5 16h7" />`,
  double: html`<rect x="3" y="3" width="12" height="12" /><path d="M9 18v3h12V9h-3" /><path d="M9 6v6M6 9h6" />`,
  delete: html`<path d="M4 6h16M9 6V3.500h6V6M6 6l1 15h10l1-15M10 10v7M14 10v7" />`,
  joined: html`<circle cx="6" cy="6" r="3" /><circle cx="18" cy="9" r="3" /><circle cx="9" cy="19" r="3" /><path d="M8.9 6.800l6.2 1.5M15.8 11l-4.7 5.9" />`,
  mirror: html`<path d="M12 3v18" stroke-dasharray="3 2.5" /><path d="M9 7v10H2z" /><path d="M15 7v10h7z" fill="currentColor" />`,
  nearer: html`<circle cx="10" cy="10" r="6.5" /><path d="M15 15l6 6M10 7v6M7 10h6" />`,
  farther: html`<circle cx="10" cy="10" r="6.5" /><path d="M15 15l6 6M7 10h6" />`,
  whole: html`<path d="M3 8V3h5M16 3h5v5M21 16v5h-5M8 21H3v-5" /><rect x="8" y="8" width="8" height="8" />`,
  snap: html`<path d="M5 4v8a7 7 0 0 0 14 0V4h-5v8a2 2 0 0 1-4 0V4zM5 8h5M14 8h5" />`,
  add: html`<rect x="3" y="3" width="14" height="14" stroke-dasharray="3 2" /><path d="M18 14v8M14 18h8" stroke-width="2.4" />`,
  pin: html`<path d="M8 3h8M9.500 3v7L6 14h12l-3.5-4V3" /><path d="M12 14v8" />`,
  car: html`<path d="M3 15v-4h4l3-4h6l2 4h3v4" /><circle cx="7.5" cy="16" r="3" fill="var(--panel)" /><circle cx="16.5" cy="16" r="3" fill="var(--panel)" />`,
  arm: html`<path d="M3 21h8M7 21v-5" /><path d="M7 14l6-8 7 5" stroke-width="3" /><circle cx="7" cy="14" r="2" fill="var(--panel)" /><circle cx="13" cy="6" r="2" fill="var(--panel)" />`,
  hopper: html`<rect x="9" y="2" width="5" height="8" /><path d="M11.5 10l-4 4.5 4 5.5h6" stroke-width="2.6" />`,
  lander: html`<path d="M8 4h8l2 8H6z" /><path d="M6 12l-3 8M18 12l3 8M1.5 20h3M19.5 20h3" /><path d="M10 15l2 5 2-5z" fill="currentColor" />`,
  cannon: html`<path d="M5 13L17 4l4 5.5L9 18z" /><circle cx="7" cy="18" r="4" fill="var(--panel)" /><circle cx="7" cy="18" r=".8" />`,
};

/** @param {{ name: string }} props */
export const Icon = ({ name }) => html`<svg class="icon" viewBox="0 0 24 24" width="20" height="20" aria-hidden="true" fill="none" stroke="currentColor"
  stroke-width="1.7" stroke-linejoin="round" stroke-linecap="round">${ICONS[/** @type {keyof typeof ICONS} */ (name)]}</svg>`;
