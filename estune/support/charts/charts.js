// Charts: a thin layer over uPlot that takes its colours from the page's style.

const dark = matchMedia("(prefers-color-scheme: dark)"), colours = new Map(); // of the present scheme
dark.addEventListener("change", () => colours.clear());
export function colour(name) {
  if (!colours.get(name)) colours.set(name, getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return colours.get(name);
}

// An element with these properties and children.
export function make(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

// Horizontal lines and bands: {at} or {from, to}, each with {colour, label}.
function marks(get) {
  return {
    hooks: {
      drawClear: (u) => {
        const { ctx, bbox } = u;
        ctx.save();
        ctx.beginPath();
        ctx.rect(bbox.left, bbox.top, bbox.width, bbox.height);
        ctx.clip();
        for (const mark of get()) {
          if (mark.from !== undefined) {
            const a = u.valToPos(mark.from, "y", true), b = u.valToPos(mark.to, "y", true);
            ctx.fillStyle = colour(mark.colour);
            ctx.fillRect(bbox.left, Math.min(a, b), bbox.width, Math.abs(a - b));
            continue;
          }
          const y = u.valToPos(mark.at, "y", true);
          ctx.strokeStyle = ctx.fillStyle = colour(mark.colour);
          ctx.lineWidth = devicePixelRatio;
          ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
          ctx.beginPath();
          ctx.moveTo(bbox.left, y);
          ctx.lineTo(bbox.left + bbox.width, y);
          ctx.stroke();
          if (mark.label) {
            ctx.font = `${11 * devicePixelRatio}px system-ui, sans-serif`;
            [ctx.textAlign, ctx.textBaseline] = ["right", "bottom"]; // the axes leave "middle", which the line would cross
            ctx.fillText(mark.label, bbox.left + bbox.width - 4, y - 3 * devicePixelRatio);
          }
        }
        ctx.restore();
      },
    },
  };
}

const WHOLE = [1, 2, 5].flatMap((n) => [0, 1, 2, 3, 4, 5, 6].map((power) => n * 10 ** power)).sort((a, b) => a - b);
const number = (value) => (value == null ? "-" : Number(value.toPrecision(4)).toString());

// A chart in a figure. `series` are {label, colour, width, dash, points, step}.
export class Chart {
  constructor(figure, { height, x, y, log = false, logX = false, whole = false, legend = true, series, bands = [], label }) {
    this.options = { height, x, y, log, logX, whole, legend, series, bands };
    this.figure = figure;
    this.marks = [];
    this.ranges = {};
    this.zoom = null;
    this.data = [[], ...series.map(() => [])];
    figure.setAttribute("role", "img");
    figure.setAttribute("aria-label", label);
    this.build();
    this.resized = new ResizeObserver(() => this.plot.setSize(this.size()));
    this.resized.observe(figure);
    this.ended = new AbortController();
    dark.addEventListener("change", () => this.build(), { signal: this.ended.signal });
  }

  // Removes the plot, and what would draw it again.
  close() {
    this.ended.abort();
    this.resized.disconnect();
    this.plot.destroy();
  }

  size() {
    return { width: Math.max(200, this.figure.clientWidth), height: this.options.height };
  }

  build() {
    this.plot?.destroy();
    const { x, y, log, logX, whole, legend, series, bands } = this.options;
    const axis = (label, more) => ({
      label, labelSize: 18, labelGap: 0, stroke: colour("ink"), font: "12px system-ui, sans-serif",
      labelFont: "12px system-ui, sans-serif", grid: { stroke: colour("rule"), width: 1 },
      ticks: { stroke: colour("rule"), width: 1 }, ...more,
    });
    const values = (u, splits) => splits.map((v) => (v == null ? "" : number(v)));
    this.plot = new uPlot({
      ...this.size(),
      scales: {
        x: { time: false, distr: logX ? 3 : 1, range: (u, low, high) => this.zoom ?? this.ranges.x ?? [low, high] },
        y: log ? { distr: 3 } : { range: (u, low, high) => this.ranges.y ?? (low == null ? [null, null] : uPlot.rangeNum(low, high, 0.1, true)) },
      },
      axes: [axis(x, { size: 34, values, incrs: whole ? WHOLE : undefined }), axis(y, { size: 62, values })],
      legend: { show: legend },
      bands: bands.map((pair) => ({ series: pair, fill: colour("blue") + "33" })),
      cursor: { drag: { x: true, y: false, setScale: false },
        bind: { dblclick: () => () => this.zoomTo(null) } },
      hooks: { setSelect: [(u) => {
        const { left, width } = u.select;
        if (width < 5) return;
        u.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
        this.zoomTo([u.posToVal(left, "x"), u.posToVal(left + width, "x")]);
      }] },
      plugins: [marks(() => this.marks)],
      series: [{ label: x, value: (u, v) => number(v) }, ...series.map((one) => ({
        label: one.label, stroke: typeof one.colour === "function" ? () => colour(one.colour()) : colour(one.colour),
        width: one.hidden ? 0 : one.width ?? 1.5, dash: one.dash,
        spanGaps: one.points !== "only", value: (u, v) => number(v),
        paths: one.points === "only" ? () => null
          : one.step ? uPlot.paths.stepped({ align: 1 }) : undefined,
        points: one.points
          ? { show: true, size: one.size ?? 5, fill: one.open ? colour("ground") : colour(one.colour) }
          : { show: false },
      }))],
    }, this.data, this.figure);
    const listed = this.plot.root.querySelectorAll(".u-legend .u-series");
    series.forEach((one, n) => one.hidden && listed[n + 1]?.remove()); // edges of a band
    this.hideEmpty();
  }

  // Shows a part of the x axis until a double click; new data leave it as it is.
  zoomTo(range) {
    this.zoom = range;
    this.plot.setData(this.data);
  }

  // New data, horizontal marks, and ranges of the axes that the data do not move. A series without
  // data is not in the legend either.
  show(data, marks = [], ranges = {}) {
    this.data = data;
    this.marks = marks;
    this.ranges = ranges;
    this.hideEmpty();
    this.plot.setData(data);
  }

  hideEmpty() {
    for (let n = 1; n < this.data.length; n++) {
      const show = this.data[n].some((value) => value != null);
      if (this.plot.series[n].show !== show) this.plot.setSeries(n, { show });
    }
  }
}

// A range that holds all values with a margin, and keeps one it had as long as they lie within.
export function held(before, columns) {
  let low = Infinity, high = -Infinity;
  for (const column of columns)
    for (const value of column ?? []) {
      if (value < low) low = value;
      if (value > high) high = value;
    }
  if (low > high) return before;
  if (before && low >= before[0] && high <= before[1]) return before;
  return uPlot.rangeNum(Math.min(low, before?.[0] ?? low), Math.max(high, before?.[1] ?? high), 0.1, true);
}

// Curves on time axes of their own, on a common one. Each is [times, values].
export const joined = (curves) => uPlot.join(curves.map(([t, v]) => [t ?? [], v ?? []]));
