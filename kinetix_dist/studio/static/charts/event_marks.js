// Events of a run on the axis of its charts: ticks with names, of which neighbours of one kind are one mark.
import uPlot from "../vendor/uPlot.esm.js";
import { colour } from "../base/theme.js";

/**
 * @typedef {{ x: number, event: string }} ChartEvent
 * @typedef {{ kind: string, count: number, from: number, to: number }} Mark from and to: pixels from the left of the plot
 */

export const LABEL_HEIGHT = 14; // pixels above the plot
const MERGED_WITHIN = 12; // pixels: closer ticks of one kind are one mark
const NEAR = 8; // pixels from the pointer
const TROUBLE = /lost|failed|failing|rejected|rolled|skipped|late|stopped|dropped|warning|damaged|aside|left_out/;

/** Plural of events that are frequent. @type {Record<string, string>} */
const MANY = {
  buffer_adopted: "buffers", checkpoint_saved: "checkpoints", evaluated: "evaluations", recorded: "recordings",
  phase_began: "phases", run_started: "starts", resumed: "resumptions", process_started: "processes started",
  process_lost: "processes lost", straggler: "stragglers", refresh_lost: "refreshes lost", buffer_late: "late buffers",
};

/** "buffer adopted", "12 buffers" @param {string} kind @param {number} count */
export function eventText(kind, count) {
  const one = kind.replaceAll("_", " ");
  if (count === 1) return one;
  return kind in MANY ? `${count} ${MANY[kind]}` : `${count} x ${one}`;
}

/** All events in one line, by kind. @param {ChartEvent[]} events */
export function summary(events) {
  /** @type {Map<string, number>} */
  const counts = new Map();
  for (const { event } of events) counts.set(event, (counts.get(event) ?? 0) + 1);
  return [...counts].map(([kind, count]) => eventText(kind, count)).join(", ");
}

/** @type {WeakMap<uPlot, { key: unknown[], marks: Mark[] }>} */
const known = new WeakMap();

/** Marks of a chart as it is zoomed now, from left to right. @param {uPlot} u @param {ChartEvent[]} events @returns {Mark[]} */
export function marksOf(u, events) {
  const key = [events, u.width, u.scales.x.min, u.scales.x.max];
  const before = known.get(u);
  if (before && before.key.every((part, k) => part === key[k])) return before.marks;
  /** @type {Map<string, Mark>} */
  const open = new Map();
  /** @type {Mark[]} */
  const marks = [];
  const { min, max } = u.scales.x;
  const start = u.data[0][0]; // of the curves: a point stands for several rows, and has the place of the last of them
  for (const { x: place, event } of events.toSorted((a, b) => a.x - b.x)) {
    const x = Math.max(place, start);
    if (min === undefined || max === undefined || min === null || max === null || x < min || x > max) continue;
    const at = u.valToPos(x, "x");
    const last = open.get(event);
    if (last && at - last.to < MERGED_WITHIN) {
      last.to = at;
      last.count++;
      continue;
    }
    const mark = { kind: event, count: 1, from: at, to: at };
    open.set(event, mark);
    marks.push(mark);
  }
  known.set(u, { key, marks });
  return marks;
}

/** Names of the marks at the pointer. @param {uPlot} u @param {ChartEvent[]} events @param {number} left */
export function textAt(u, events, left) {
  const near = marksOf(u, events).filter((mark) => left >= mark.from - NEAR && left <= mark.to + NEAR);
  return near.map((mark) => eventText(mark.kind, mark.count)).join(", ");
}

/** Ticks at the top of the plot, trouble over all of it; names above where there is room, those of trouble first.
 * @param {uPlot} u @param {ChartEvent[]} events */
export function drawEvents(u, events) {
  const { ctx, bbox } = u;
  const scale = uPlot.pxRatio;
  const marks = marksOf(u, events);
  ctx.save();
  ctx.font = `${10 * scale}px system-ui, sans-serif`;
  ctx.textBaseline = "alphabetic";
  ctx.textAlign = "left";
  for (const { kind, from, to } of marks) {
    const isTrouble = TROUBLE.test(kind);
    const left = Math.round(bbox.left + from * scale);
    ctx.fillStyle = colour(isTrouble ? "bad" : "event");
    ctx.fillRect(left, bbox.top, Math.max(Math.round((to - from) * scale), 2), (from === to ? 9 : 4) * scale);
    if (isTrouble) ctx.fillRect(left, bbox.top, scale, bbox.height);
  }
  /** @type {[number, number][]} */
  const taken = [];
  for (const { kind, count, from, to } of [...marks.filter((mark) => TROUBLE.test(mark.kind)), ...marks.filter((mark) => !TROUBLE.test(mark.kind))]) {
    const text = eventText(kind, count);
    const width = ctx.measureText(text).width;
    const wanted = bbox.left + ((from + to) / 2) * scale - width / 2;
    const left = Math.max(bbox.left - 2 * scale, Math.min(wanted, ctx.canvas.width - width - 2 * scale));
    if (taken.some(([start, end]) => left < end && left + width > start)) continue;
    taken.push([left - 6 * scale, left + width + 6 * scale]);
    ctx.fillStyle = colour(TROUBLE.test(kind) ? "bad" : "ink-soft");
    ctx.fillText(text, left, bbox.top - 4 * scale);
  }
  ctx.restore();
}
