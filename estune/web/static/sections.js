// Sections of the page: trial, search, result, check trials, events.

import { Chart, held, joined, make } from "./charts.js";

const $ = (id) => document.getElementById(id);
const timeUnit = (s) => (s < 600 ? ["s", 1] : s < 36000 ? ["min", 60] : ["h", 3600]);
const last = (rows) => rows[rows.length - 1];

export class Sections {
  constructor() {
    this.charts = {};
    this.others = []; // runs laid over this one: {name, curve}
    this.clear();
  }

  clear() {
    this.values = {};
    this.tables = { trials: [], samples: [], events: [], checks: [] };
    this.changed = new Set();
  }

  take({ values, tables }) {
    for (const [name, value] of Object.entries(values)) {
      this.values[name] = value;
      this.changed.add(name);
    }
    for (const [name, { restart, rows }] of Object.entries(tables)) {
      if (restart) this.tables[name] = [];
      for (const row of rows) this.tables[name].push(row);
      this.changed.add(name);
    }
  }

  draw() {
    const has = (...names) => names.some((name) => this.changed.has(name));
    if (has("description", "facts", "predicted.rig", "predicted.run", "state")) this.drawAbout();
    if (has("curve.start", "curve.best", "curve.latest", "curve.tuned", "curve.tried", "samples", "live", "other", "description", "run"))
      this.drawTrial();
    if (has("trials", "state", "expected")) this.drawSearch();
    if (has("result", "description", "run")) this.values.result ? this.drawResult() : ($("decision").hidden = true);
    if (has("checks", "daemon")) this.drawChecks();
    if (has("events")) this.drawEvents();
    this.changed.clear();
  }

  chart(id, options, figure = $(id)) {
    return (this.charts[id] ??= new Chart(figure, options));
  }

  remove(id) {
    this.charts[id]?.close();
    delete this.charts[id];
  }

  // Removes what is drawn, for the sections of another view.
  close() {
    Object.keys(this.charts).forEach((id) => this.remove(id));
    $("gains").replaceChildren();
  }

  // What the rig is, its live gains, and what is predicted of them while nothing moves.
  drawAbout() {
    const { description: about, facts = [], state } = this.values, predicted = this.values["predicted.run"] ?? this.values["predicted.rig"];
    const list = (id, rows) => $(id).replaceChildren(...rows.map(([name, value]) => make("div", {}, make("dt", {}, name), make("dd", {}, value))));
    list("facts", facts);
    $("text").hidden = !about;
    $("text").textContent = about?.text;
    $("live").hidden = !about || state?.status === "running";
    if ($("live").hidden) return;
    list("gains-live", [...about.gain_labels.map((name, n) => [name, Number(about.gains[n].toPrecision(4))]), ...(predicted?.cells ?? [])]);
    $("predicted-by").textContent = predicted ? `The response with these gains, predicted by ${predicted.source}:` : "No model is known that predicts the response; a tuning identifies one.";
    $("predicted").hidden = !predicted;
    if (!predicted) return;
    const [unit, unit_s] = timeUnit(last(predicted.t));
    this.chart("predicted", { height: 180, x: `time from the step, ${unit}`, y: about.measurement, label: "Predicted step response with the live gains",
      legend: false, series: [{ label: "setpoint", colour: "grey", dash: [6, 4], width: 1 }, { label: "predicted", colour: "blue", width: 1.8 }] })
      .show([predicted.t.map((t) => t / unit_s), predicted.r, predicted.y]);
  }

  drawTrial() {
    const v = this.values, about = v.run ?? v.description;
    if (!about) return;
    const isEmpty = !this.tables.samples.length && !["start", "best", "latest", "tuned", "tried"].some((name) => v[`curve.${name}`]);
    $("trial").hidden = isEmpty;
    if (isEmpty) return;
    const others = this.others.filter(({ curve }) => !curve || curve.measurement === about.measurement);
    const curves = [["curve.start", "initial gains"], [v["curve.tuned"] ? "curve.tuned" : "curve.best", v["curve.tuned"] ? "tuned gains" : "best so far"]];
    const samples = this.tables.samples, per = about.per_ampere;
    const isLive = v.live && !(v.live.run === v.run?.name && v.live.number < (v["curve.latest"]?.number ?? -1)); // a fast run is ahead of it
    const now = isLive
      ? { t: samples.map((r) => r[0]), r: samples.map((r) => r[1]), y: samples.map((r) => r[2]), u: samples.map((r) => r[3] * per) }
      : v["curve.tuned"] ? undefined : v["curve.latest"]; // which is as good as the tuned one
    const tried = v["curve.tried"];
    const shown = [...curves.map(([name]) => v[name]), ...others.map((one) => one.curve), ...(tried ? [tried] : []), now].map((one) => one ?? {});
    const setpoint = now?.t?.length ? now : v["curve.start"] ?? {};
    const step = about.step_at_s ?? 0;
    const [unit, unit_s] = timeUnit(last((v["curve.start"] ?? now ?? {}).t ?? [0]));
    const shifted = (one) => one.t?.map((t) => (t - (one.step ?? step)) / unit_s);
    const series = [
      { label: "setpoint", colour: "grey", dash: [6, 4], width: 1 },
      { label: "initial gains", colour: "orange", dash: [8, 3] },
      { label: curves[1][1], colour: "green", width: 1.8 },
      ...others.map(({ name }, n) => ({ label: name, colour: n % 2 ? "red" : "purple", dash: [[2, 3], [6, 3], [9, 3, 2, 3]][n >> 1] })),
      ...(tried ? [{ label: "tried once", colour: "red", dash: [2, 3], width: 1.6 }] : []),
      { label: isLive ? "live" : "latest trial", colour: "blue", width: 1.4 },
    ];
    const x = `time from the step, ${unit}`;
    const labels = [x, ...series.map((one) => one.label)].join();
    if (labels !== this.labels) { // a chart has the labels with which it was made
      this.labels = labels;
      for (const id of ["response", "command"]) this.remove(id);
    }
    const response = this.chart("response", { height: 260, x, y: about.measurement, series,
      label: `${about.measurement} over time: initial gains, best, and the latest trial` });
    const limits = (pair) => (pair ?? []).filter((at) => at !== null && Math.abs(at) < 1e8).map((at) => ({ at, colour: "red", label: "limit" }));
    const trial = isLive ? v.live.trial_id : "", ends = about.duration_s ? [-step / unit_s, (about.duration_s - step) / unit_s] : undefined;
    if (this.held?.trial !== trial || this.held.labels !== labels) this.held = { trial, labels }; // axes hold still within a trial
    this.held.y = held(this.held.y, [setpoint.r, ...shown.map((one) => one.y)]);
    this.held.u = held(this.held.u, shown.map((one) => one.u));
    response.show(joined([[shifted(setpoint), setpoint.r], ...shown.map((one) => [shifted(one), one.y])]),
      limits(v.description?.measurement_limits), { x: ends, y: this.held.y });
    const command = this.chart("command", { height: 200, x, y: about.command, series: series.slice(1),
      label: `${about.command} over time` });
    command.show(joined(shown.map((one) => [shifted(one), one.u])), limits(about.command_limits), { x: ends, y: this.held.u });
    const number = isLive ? `under way, of ${v.live.run}` : v["curve.latest"] ? `trial ${v["curve.latest"].number} of ${v.run?.name}` : "";
    const apart = this.others.filter((one) => !others.includes(one)).map(({ name }) => name).join(", ");
    $("trial-text").textContent = apart ? `${number}; not drawn, for they measure something else: ${apart}` : number;
  }

  drawSearch() {
    const { run, state } = this.values, trials = this.tables.trials;
    $("search").hidden = !run || !state || !trials.length;
    if ($("search").hidden) return;
    let best = null;
    const safe = [], unsafe = [], so_far = [];
    const top = state.eta_max ?? Math.max(...trials.map((r) => r[1] ?? 0));
    for (const [, cost, kind, phase] of trials) {
      safe.push(kind === 0 ? cost : null);
      unsafe.push(kind === 1 ? top : null);
      if (kind === 0 && phase < 2 && (best === null || cost < best)) best = cost;
      so_far.push(best);
    }
    const marks = [];
    if (state.best && state.repeatability) {
      const half = Math.exp(1.96 * state.repeatability);
      marks.push({ from: state.best.cost / half, to: state.best.cost * half, colour: "band" });
    }
    if (state.start_cost) marks.push({ at: state.start_cost, colour: "orange", label: "initial gains" });
    if (unsafe.some((x) => x !== null) && state.eta_max) marks.push({ at: state.eta_max, colour: "red", label: "unsafe above" });
    const cost = this.chart("cost", { height: 240, x: "trial", whole: true, y: "cost (1 = as good as first order)", log: true,
      label: "Cost of each trial, the best so far, and the band of noise about it",
      series: [{ label: "cost", colour: "blue", points: "only" }, { label: "unsafe", colour: "red", points: "only", size: 8, open: true },
        { label: "best so far", colour: "ink", step: true }] });
    const numbers = trials.map((r) => r[0]);
    cost.show([numbers, safe, unsafe, so_far], marks);
    this.drawGains(numbers);
    $("search-text").textContent = state.text;
  }

  drawGains(numbers) {
    const { run, state, expected } = this.values, trials = this.tables.trials;
    run.gain_labels.forEach((label, n) => {
      const id = `gain-${n}`, name = run.gains[n];
      if (!this.charts[id]) {
        const figure = document.createElement("figure");
        $("gains").append(figure);
        this.chart(id, { height: 150, x: "trial", whole: true, y: label, log: true, legend: false, label: `${label} over the trials`,
          series: [{ label, colour: "blue", points: true, size: 4 }, { label: "next", colour: "red", points: "only", size: 9, open: true }] }, figure);
      }
      const positive = (x) => (x > 0 ? x : null);
      const values = trials.map((r) => positive(r[4 + n]));
      const next = values.map(() => null);
      const x = [...numbers];
      if (state.next) {
        x.push((last(numbers) ?? -1) + 1);
        values.push(null);
        next.push(positive(state.next[n]));
      }
      const marks = [];
      const interval = expected?.intervals?.[name];
      if (interval) marks.push({ from: interval[0], to: interval[1], colour: "band" });
      for (const at of run.bounds[name] ?? []) marks.push({ at, colour: "grey", label: "bound" });
      this.charts[id].show([x, values, next], marks);
    });
  }

  drawResult() {
    const { result, run, description: about } = this.values, { heading, good, tuned, rows, remarks, offer } = result;
    $("decision").hidden = false;
    $("result-of").textContent = run ? `Result of ${run.name}` : "Result";
    $("heading").textContent = heading;
    $("heading").className = `lead ${good ? "yes" : good === false ? "no" : ""}`;
    const isLive = offer?.gains && about && Object.values(offer.gains).every((x, n) => Math.abs(x - about.gains[n]) <= 1e-9 * Math.abs(x));
    $("offer").hidden = !this.mayApply || !offer?.gains || !about || isLive;
    $("offered").textContent = offer?.refused || (isLive ? "These gains are live." : "");
    const heads = ["", "initial gains", ...(tuned ? ["tuned gains"] : [])];
    const line = (tag, cells) => make("tr", {}, ...cells.map((text, n) =>
      make(n ? tag : "th", { textContent: text, ...(!n && text && { scope: "row" }) })));
    $("result").replaceChildren(line("th", heads), ...rows.map((row) => line("td", row.slice(0, heads.length))));
    $("remarks").replaceChildren(...remarks.map((text) => make("li", {}, text)));
  }

  drawChecks() {
    const rows = this.tables.checks.filter((row) => row[2] !== null), { daemon } = this.values;
    if (!rows.length) return;
    $("checks").hidden = false;
    const chart = this.chart("chart", { height: 200, x: "check trial", whole: true, y: "cost",
      label: "Cost of the check trials over their number, with the baseline",
      series: [{ label: "steady", colour: "blue", points: "only" }, { label: "changed", colour: "red", points: "only", size: 8, open: true },
        ...["lower alarm limit", "upper alarm limit"].map((label) => ({ label, colour: "red", dash: [6, 4], width: 1, step: true }))] });
    const steady = (row) => row[3] === "steady";
    const marks = [];
    if (daemon?.baseline_cost) marks.push({ at: daemon.baseline_cost, colour: "orange", label: "baseline" });
    const column = (n) => rows.map((row) => row[n]);
    chart.show([column(0), rows.map((row) => (steady(row) ? row[2] : null)), rows.map((row) => (steady(row) ? null : row[2])), column(4), column(5)], marks);
  }

  drawEvents() {
    $("events").hidden = false;
    $("events").querySelector("tbody").replaceChildren(...this.tables.events.slice(-100).reverse().map(([, at, kind, sentence]) =>
      make("tr", {}, ...[new Date(at).toLocaleString(), kind, sentence].map((text) => make("td", {}, text)))));
  }

  // Lays the responses of other runs over this one, one after the other: a browser opens few streams.
  async layOver(names) {
    this.wanted = names;
    const kept = this.others.filter(({ name }) => names.includes(name));
    for (const name of names)
      if (!kept.some((one) => one.name === name)) kept.push({ name, curve: await curveOf(name) });
    if (this.wanted !== names) return; // others were chosen meanwhile
    this.others = kept;
    this.changed.add("other");
    this.draw();
  }
}

const CURVE_WITHIN_MS = 10000;

// The response of the best gains of a run; nothing for one without.
function curveOf(name) {
  return new Promise((resolve) => {
    const stream = new EventSource(`api/events?view=${encodeURIComponent(name)}`);
    const end = (curve) => { stream.close(); clearTimeout(timer); resolve(curve); };
    const timer = setTimeout(end, CURVE_WITHIN_MS);
    let about = {};
    stream.onmessage = (event) => {
      const { values } = JSON.parse(event.data), curve = values["curve.tuned"] ?? values["curve.best"];
      if (values.run) about = { step: values.run.step_at_s, measurement: values.run.measurement };
      if (curve) end({ ...curve, ...about });
    };
    stream.onerror = () => end();
  });
}
