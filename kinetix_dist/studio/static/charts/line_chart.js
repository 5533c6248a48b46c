// Curves over a shared axis: lines with bands (smallest to largest, or an interval), events as marks, zoom by dragging.
import "../base/language.js";
import uPlot from "../vendor/uPlot.esm.js";
import { html, useEffect, useRef } from "../base/html.js";
import { short } from "../base/format.js";
import { colour, lineStyle } from "../base/theme.js";

/**
 * @typedef {object} Line
 * @property {string} label
 * @property {(number | null)[]} values one for each x
 * @property {(number | null)[]} [low] lower end of a band
 * @property {(number | null)[]} [high]
 * @property {number} [style] number of its colour and dashes; its place in the chart where it is left out
 */

const HEIGHT = 190;
const LEGEND_LINES = 12;

/**
 * `fill` stacks the lines as areas. `onZoom(null, null)`: all of it.
 * @param {{ x: number[], lines: Line[], axis: string, log?: boolean, stacked?: boolean, height?: number,
 *   events?: { x: number, event: string }[], range?: [number | null, number | null],
 *   hold?: (chart: uPlot | null) => void, onZoom?: (from: number | null, to: number | null) => void }} props
 */
export function LineChart(props) {
  const place = useRef(/** @type {HTMLDivElement | null} */ (null));
  const chart = useRef(/** @type {uPlot | null} */ (null));
  const shape = JSON.stringify([props.lines.map((line) => [line.label, Boolean(line.low)]), props.axis,
    props.log, props.stacked, props.height]);

  useEffect(() => {
    const element = /** @type {HTMLDivElement} */ (place.current);
    const make = () => {
      chart.current?.destroy();
      chart.current = new uPlot(options(props, element.clientWidth), dataOf(props), element);
      props.hold?.(chart.current);
    };
    make();
    const observer = new ResizeObserver(() => {
      const width = element.clientWidth;
      if (width && chart.current && chart.current.width !== width) {
        chart.current.setSize({ width, height: props.height ?? HEIGHT });
      }
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
  const newest = useRef(props);
  newest.current = props;
  const draw = () => {
    if (!chart.current) return;
    const { x, lines, range = [null, null], events } = newest.current;
    latest.set(chart.current, newest.current);
    const shown = [chart.current, x, events, ...range, ...lines.flatMap((line) => [line.values, line.low, line.high])];
    if (!isInSight.current || (shown.length === drawn.current.length && shown.every((value, k) => value === drawn.current[k]))) return;
    drawn.current = shown;
    chart.current.setData(dataOf(newest.current));
    const [from, to] = range;
    if ((from !== null || to !== null) && x.length) {
      chart.current.setScale("x", { min: from ?? x[0], max: to ?? x[x.length - 1] });
    }
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

  return html`<div class="chart" ref=${place}></div>`;
}

/** Current contents of a chart: hooks of uPlot are made once. @type {WeakMap<any, any>} */
const latest = new WeakMap();

/** @param {any} props @returns {any} */
function dataOf(props) {
  /** @type {any[]} */
  const columns = [props.x];
  if (props.stacked) {
    const sums = props.x.map(() => 0);
    const stacked = props.lines.map((/** @type {Line} */ line) =>
      line.values.map((value, k) => (sums[k] += value ?? 0)),
    );
    return [props.x, ...stacked];
  }
  for (const line of props.lines) {
    columns.push(line.values.map((/** @type {number | null} */ value) => (props.log && value !== null && value <= 0 ? null : value)));
    if (line.low && line.high) columns.push(line.low, line.high);
  }
  return columns;
}

/** @param {any} props @param {number} width @returns {uPlot.Options} */
function options(props, width) {
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
      series.push({ label: line.label, stroke, width: 1, fill: index ? undefined : `${stroke}66`,
        value: (u, _, __, k) => short(k === null ? null : latest.get(u)?.lines[index]?.values[k]) });
      if (index) bands.push({ series: [own, own - 1], fill: `${stroke}66` });
      return;
    }
    series.push({
      label: line.label,
      stroke,
      dash,
      width: 1.5,
      points: { show: false, filter: (u, number) => lonely(u.data[number]), size: 6, fill: stroke },
      value: (/** @type {uPlot} */ u, /** @type {number | null} */ value, /** @type {number} */ __, /** @type {number | null} */ k) =>
        valueText(latest.get(u)?.lines[index], value, k),
    });
    if (line.low && line.high) {
      // Edges of bands have no row in the legend: they follow their curve.
      const edge = { stroke: "transparent", points: { show: false }, class: "hidden" };
      series.push(edge, { ...edge });
      bands.push({ series: [own + 2, own + 1], fill: `${stroke}33` });
    }
  });
  const isDate = props.axis === "date";
  return {
    width: Math.max(width, 200),
    height: props.height ?? HEIGHT,
    series,
    bands,
    padding: [8, 16, 0, 0],
    legend: { show: props.lines.length <= LEGEND_LINES, live: true },
    scales: { x: { time: isDate }, y: props.log ? { distr: 3 } : { range: (_, low, high) => rangeOf(low, high) } },
    axes: [
      { stroke: ink, grid, ticks: grid, values: isDate ? undefined : (_, ticks) => ticks.map(short) },
      { stroke: ink, grid, ticks: grid, size: 56, values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : short(tick))) },
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
        },
      ],
      draw: [(u) => drawEvents(u, latest.get(u)?.events ?? [])],
    },
  };
}

/** Limits with a margin around the values; constants have 1 around them. @param {number | null} low @param {number | null} high
 * @returns {[number, number]} */
function rangeOf(low, high) {
  if (low === null || high === null) return [0, 1];
  if (low === high) return low === 0 ? [0, 1] : [Math.min(low, 0), Math.max(1.2 * high, 0)];
  const margin = 0.06 * (high - low);
  return [low >= 0 && low < margin ? 0 : low - margin, high + margin];
}

/** Places of values without a neighbour, which no line shows; null where there is none. What is undefined is bridged.
 * @param {ArrayLike<number | null | undefined>} values @returns {number[] | null} */
function lonely(values) {
  const places = [...Array(values.length).keys()].filter((k) => values[k] !== undefined);
  const has = (/** @type {number} */ at) => at >= 0 && at < places.length && values[places[at]] !== null;
  const found = places.filter((_, at) => has(at) && !has(at - 1) && !has(at + 1));
  return found.length ? found : null;
}

/** @param {Line | undefined} line @param {number | null} value @param {number | null} k */
function valueText(line, value, k) {
  if (value === null || value === undefined) return "-";
  const low = k === null ? null : line?.low?.[k];
  const high = k === null ? null : line?.high?.[k];
  return low === null || low === undefined ? short(value) : `${short(value)} (${short(low)} to ${short(high)})`;
}

/** @param {uPlot} u @param {{ x: number, event: string }[]} events */
function drawEvents(u, events) {
  const { ctx, bbox } = u;
  ctx.save();
  ctx.beginPath();
  ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
  ctx.clip();
  for (const { x, event } of events) {
    const at = Math.round(u.valToPos(x, "x", true));
    const isTrouble = /lost|failed|rejected|rolled|skipped|late|stopped|dropped/.test(event);
    ctx.fillStyle = colour(isTrouble ? "bad" : "event");
    ctx.fillRect(at, isTrouble ? bbox.top : bbox.top + bbox.height - 10, 2, isTrouble ? bbox.height : 10);
  }
  ctx.restore();
}
