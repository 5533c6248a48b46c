// Curves over a shared axis: lines with bands (smallest to largest, or an interval), events as marks, zoom by dragging.
// The pointer or arrow keys show values in the legend, whose place is reserved: nothing moves.
import "../base/language.js";
import uPlot from "../vendor/uPlot.esm.js";
import { smooth } from "../base/format.js";
import { html, useEffect, useRef, useState } from "../base/html.js";
import { colour, lineStyle } from "../base/theme.js";
import { rangeOf, tickLabels } from "./axes.js";
import { drawEvents, LABEL_HEIGHT, summary, textAt } from "./event_marks.js";
import { Legend, showValues } from "./legend.js";

/**
 * @typedef {object} Line
 * @property {string} label
 * @property {(number | null)[]} values one for each x
 * @property {(number | null)[]} [low] lower end of a band
 * @property {(number | null)[]} [high]
 * @property {number} [style] number of its colour and dashes; its place in the chart where it is left out
 * @property {boolean} [isMeasured] single measurements: a point each, with its interval instead of a band
 */

/**
 * @typedef {object} LineChartProps
 * @property {number[]} x
 * @property {Line[]} lines
 * @property {string} axis unit of x
 * @property {number} [smoothing] weight of the average, 0 (none) to below 1; what is averaged stays, faint
 * @property {number | null} [normal] highest value of a healthy run: drawn as a band from 0
 * @property {boolean} [log]
 * @property {boolean} [stacked] lines as areas on each other
 * @property {number} [height] of the plot, in pixels
 * @property {{ x: number, event: string }[]} [events]
 * @property {[number | null, number | null]} [range] of x; null: to the end
 * @property {(chart: uPlot | null) => void} [hold]
 * @property {(from: number | null, to: number | null) => void} [onZoom] null, null: all of it
 */

const HEIGHT = 190;
const LEGEND_LINES = 12;

/** @param {LineChartProps} props */
export function LineChart(props) {
  const place = useRef(/** @type {HTMLDivElement | null} */ (null));
  const legend = useRef(/** @type {HTMLElement | null} */ (null));
  const eventLine = useRef(/** @type {HTMLElement | null} */ (null));
  const chart = useRef(/** @type {uPlot | null} */ (null));
  const [hidden, setHidden] = useState(/** @type {Set<string>} */ (new Set()));
  const { lines, events = [], height = HEIGHT } = props;
  const newest = useRef(props);
  newest.current = props;
  const shape = JSON.stringify([lines.map((line) => [line.label, Boolean(line.low), line.isMeasured, line.style]), props.axis,
    props.log, props.stacked, height, isSmoothed(props), props.normal, events.length > 0]);

  useEffect(() => {
    const element = /** @type {HTMLDivElement} */ (place.current);
    const make = () => {
      chart.current?.destroy();
      chart.current = new uPlot(options(newest.current, element.clientWidth, readOut), dataOf(newest.current), element);
      hide(chart.current, newest.current, hidden);
      props.hold?.(chart.current);
    };
    make();
    const observer = new ResizeObserver(() => {
      const width = element.clientWidth;
      if (width && chart.current && chart.current.width !== width) chart.current.setSize({ width, height });
    });
    observer.observe(element);
    addEventListener("themechange", make);
    return () => {
      observer.disconnect();
      removeEventListener("themechange", make);
      chart.current?.destroy();
      chart.current = null;
      props.hold?.(null);
    };
  }, [shape]);

  // Drawn again when it shows something else, and not before it is in sight: a page has dozens of charts.
  const drawn = useRef(/** @type {unknown[]} */ ([]));
  const isInSight = useRef(true);
  /** Values at the pointer, or the last ones. @param {uPlot} u */
  const readOut = (u) => {
    if (!isInSight.current) return;
    const { x, lines, axis, smoothing = 0, events = [] } = newest.current;
    const at = u.cursor.idx ?? null;
    if (legend.current) showValues(legend.current, { x, lines, axis, values: lines.map((line) => smooth(line.values, smoothing)) }, at);
    if (eventLine.current) eventLine.current.textContent = at === null ? summary(events) : textAt(u, events, u.cursor.left ?? -1);
  };
  const draw = () => {
    if (!chart.current) return;
    const { x, lines, range = [null, null], events, smoothing } = newest.current;
    latest.set(chart.current, newest.current);
    const shown = [chart.current, x, events, smoothing, ...range, ...lines.flatMap((line) => [line.values, line.low, line.high])];
    if (!isInSight.current || (shown.length === drawn.current.length && shown.every((value, k) => value === drawn.current[k]))) return;
    drawn.current = shown;
    chart.current.setData(dataOf(newest.current));
    const [from, to] = range;
    if ((from !== null || to !== null) && x.length) {
      chart.current.setScale("x", { min: from ?? x[0], max: to ?? x[x.length - 1] });
    }
    readOut(chart.current);
  };
  useEffect(draw);
  useEffect(() => {
    const observer = new IntersectionObserver((entries) => {
      isInSight.current = entries[entries.length - 1].isIntersecting;
      draw();
    }, { rootMargin: "200px" });
    observer.observe(/** @type {HTMLDivElement} */ (place.current));
    return () => observer.disconnect();
  }, []);

  const toggle = (/** @type {string} */ label) => {
    const next = new Set(hidden);
    if (!next.delete(label)) next.add(label);
    setHidden(next);
    if (chart.current) hide(chart.current, newest.current, next);
  };
  return html`<div class="line-chart">
    <div class="chart" ref=${place} style=${{ height: `${height}px` }} tabindex="0" role="group" aria-label=${`chart of ${lines.map((line) => line.label).join(", ")}; arrow keys read values`}
      onKeyDown=${(/** @type {KeyboardEvent} */ event) => chart.current && moveCursor(chart.current, event)}
      onFocus=${() => legend.current?.setAttribute("aria-live", "polite")}
      onBlur=${() => (legend.current?.removeAttribute("aria-live"), chart.current?.setCursor({ left: -10, top: -10 }))}></div>
    ${lines.length <= LEGEND_LINES ? html`<${Legend} lines=${lines} hidden=${hidden} toggle=${props.stacked || lines.length < 2 ? null : toggle}
      hold=${(/** @type {HTMLElement | null} */ element) => (legend.current = element)} />` : null}
    ${events.length ? html`<p class="events-here"><span ref=${eventLine} title="marks above the chart"></span></p>` : null}
  </div>`;
}

/** Arrow keys, Home and End move the cursor from value to value, Shift by ten; Escape removes it.
 * @param {uPlot} u @param {KeyboardEvent} event */
function moveCursor(u, event) {
  const last = u.data[0].length - 1;
  const at = u.cursor.idx;
  const step = event.shiftKey ? 10 : 1;
  /** @type {Record<string, number>} */
  const places = { ArrowLeft: (at ?? last + 1) - step, ArrowRight: (at ?? -1) + step, Home: 0, End: last };
  if (event.key === "Escape") u.setCursor({ left: -10, top: -10 });
  if (!(event.key in places) || last < 0) return;
  event.preventDefault();
  const index = Math.min(Math.max(places[event.key], 0), last);
  u.setCursor({ left: Math.min(Math.max(u.valToPos(u.data[0][index], "x"), 0), u.over.clientWidth), top: 8 });
}

/** @param {LineChartProps} props */
function isSmoothed(props) {
  return Boolean(props.smoothing) && !props.stacked;
}

/** Series of uPlot that belong to each line, in the order in which `dataOf` and `options` make them.
 * @param {LineChartProps} props @returns {number[][]} */
function seriesOf(props) {
  let next = 1;
  return props.lines.map((line) => {
    const count = props.stacked ? 1 : 1 + (isSmoothed(props) ? 1 : 0) + (line.low && line.high ? 2 : 0);
    next += count;
    return [...Array(count).keys()].map((k) => next - count + k);
  });
}

/** @param {uPlot} u @param {LineChartProps} props @param {Set<string>} hidden */
function hide(u, props, hidden) {
  seriesOf(props).forEach((series, k) => {
    const show = !hidden.has(props.lines[k].label);
    for (const index of series) if (u.series[index] && u.series[index].show !== show) u.setSeries(index, { show });
  });
}

/** Current contents of a chart: hooks of uPlot are made once. @type {WeakMap<any, any>} */
const latest = new WeakMap();

/** @param {LineChartProps} props @returns {any} */
function dataOf(props) {
  const { smoothing = 0 } = props;
  /** @type {any[]} */
  const columns = [props.x];
  if (props.stacked) {
    const sums = props.x.map(() => 0);
    for (const line of props.lines) columns.push(smooth(line.values, smoothing).map((value, k) => (sums[k] += value ?? 0)));
    return columns;
  }
  const drawable = (/** @type {(number | null)[]} */ values) => (props.log ? values.map((value) => (value !== null && value <= 0 ? null : value)) : values);
  for (const line of props.lines) {
    if (isSmoothed(props)) columns.push(drawable(line.values));
    columns.push(drawable(smooth(line.values, smoothing)));
    if (line.low && line.high) columns.push(line.low, line.high);
  }
  return columns;
}

/** @param {LineChartProps} props @param {number} width @param {(u: uPlot) => void} readOut @returns {uPlot.Options} */
function options(props, width, readOut) {
  const ink = colour("ink-soft");
  const grid = { stroke: colour("grid"), width: 1 };
  /** @type {uPlot.Series[]} */
  const series = [{ label: props.axis }];
  /** @type {uPlot.Band[]} */
  const bands = [];
  props.lines.forEach((/** @type {Line} */ line, /** @type {number} */ index) => {
    const { stroke, dash } = lineStyle(line.style ?? index);
    const own = series.length;
    if (props.stacked) {
      series.push({ label: line.label, stroke, width: 1, fill: index ? undefined : `${stroke}66` });
      if (index) bands.push({ series: [own, own - 1], fill: `${stroke}66` });
      return;
    }
    if (isSmoothed(props)) series.push({ label: line.label, stroke: `${stroke}4d`, width: 1, points: { show: false } });
    series.push({
      label: line.label,
      stroke,
      dash,
      width: 1.5,
      spanGaps: line.isMeasured,
      points: line.isMeasured ? { show: true, size: 7, fill: stroke } : { show: false, filter: (u, number) => lonely(u.data[number]), size: 6, fill: stroke },
    });
    if (line.low && line.high) {
      const edge = { stroke: "transparent", points: { show: false } };
      const first = series.length;
      series.push(edge, { ...edge });
      if (!line.isMeasured) bands.push({ series: [first + 1, first], fill: `${stroke}33` });
    }
  });
  const isDate = props.axis === "date";
  const normal = props.normal ?? 0;
  return {
    width: Math.max(width, 200),
    height: props.height ?? HEIGHT,
    series,
    bands,
    padding: [props.events?.length ? LABEL_HEIGHT + 8 : 8, 16, 0, 0],
    legend: { show: false },
    scales: {
      x: { time: isDate },
      y: props.log ? { distr: 3 } : { range: (_, low, high) => (normal && high !== null ? rangeOf(Math.min(low, 0), Math.max(high, normal)) : rangeOf(low, high)) },
    },
    axes: [
      { stroke: ink, grid, ticks: grid, size: isDate ? 50 : 34, values: isDate ? undefined : (_, ticks) => tickLabels(ticks) },
      { stroke: ink, grid, ticks: grid, size: (u, labels) => labelSpace(u, labels), values: (_, ticks) => tickLabels(ticks) },
    ],
    cursor: { sync: { key: "runs", setSeries: false }, drag: { x: true, y: false, setScale: false }, focus: { prox: 20 } },
    hooks: {
      setSelect: [
        (u) => {
          if (u.select.width < 3) return;
          latest.get(u)?.onZoom?.(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
          u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        },
      ],
      ready: [
        (u) => {
          latest.set(u, props);
          u.over.addEventListener("dblclick", () => latest.get(u)?.onZoom?.(null, null));
          readOut(u);
        },
      ],
      setCursor: [readOut],
      drawClear: [(u) => drawNormal(u, normal)],
      draw: [(u) => drawIntervals(u, latest.get(u) ?? props), (u) => drawEvents(u, latest.get(u)?.events ?? [])],
    },
  };
}

/** Width of the vertical axis: as its widest label needs. @param {uPlot} u @param {string[] | null} labels */
function labelSpace(u, labels) {
  u.ctx.save();
  u.ctx.font = `${12 * uPlot.pxRatio}px system-ui, sans-serif`;
  const widest = Math.max(0, ...(labels ?? []).map((label) => u.ctx.measureText(label).width / uPlot.pxRatio));
  u.ctx.restore();
  return Math.max(56, Math.ceil(widest) + 18);
}

/** Band from 0 to the highest value of a healthy run. @param {uPlot} u @param {number} normal */
function drawNormal(u, normal) {
  const { ctx, bbox } = u;
  if (!normal || u.scales.y.min === undefined) return;
  const y = (/** @type {number} */ value) => Math.min(Math.max(u.valToPos(value, "y", true), bbox.top), bbox.top + bbox.height);
  ctx.save();
  ctx.fillStyle = `${colour("good")}22`;
  ctx.fillRect(bbox.left, y(normal), bbox.width, y(0) - y(normal));
  ctx.fillStyle = colour("good");
  ctx.fillRect(bbox.left, y(normal), bbox.width, uPlot.pxRatio);
  ctx.restore();
}

/** Interval of each measurement, as a line from end to end. @param {uPlot} u @param {LineChartProps} props */
function drawIntervals(u, props) {
  const { ctx, bbox } = u;
  const scale = uPlot.pxRatio;
  const series = seriesOf(props);
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  props.lines.forEach((line, index) => {
    if (!line.isMeasured || !line.low || !line.high || !u.series[series[index][0]]?.show) return;
    ctx.fillStyle = lineStyle(line.style ?? index).stroke;
    props.x.forEach((x, k) => {
      const low = line.low?.[k];
      const high = line.high?.[k];
      if (low === null || low === undefined || high === null || high === undefined) return;
      const [at, top, bottom] = [u.valToPos(x, "x", true), u.valToPos(high, "y", true), u.valToPos(low, "y", true)];
      ctx.fillRect(at - scale / 2, top, scale, bottom - top);
      ctx.fillRect(at - 3 * scale, top, 6 * scale, scale);
      ctx.fillRect(at - 3 * scale, bottom - scale, 6 * scale, scale);
    });
  });
  ctx.restore();
}

/** Places of values without a neighbour, which no line shows; null where there is none. What is undefined is bridged.
 * @param {ArrayLike<number | null | undefined>} values @returns {number[] | null} */
function lonely(values) {
  const places = [...Array(values.length).keys()].filter((k) => values[k] !== undefined);
  const has = (/** @type {number} */ at) => at >= 0 && at < places.length && values[places[at]] !== null;
  const found = places.filter((_, at) => has(at) && !has(at - 1) && !has(at + 1));
  return found.length ? found : null;
}
