// The tuning page: sliders for limits and gains, and what the identified loop predicts of them.

import { Chart, make } from "./charts.js";
import { columns, loopGain, predict, robustness, simulate } from "./loop.js";
import { Nyquist } from "./nyquist.js";
import { FORMS, written } from "./gains.js";
import { optimum, TOLERANCE } from "./optimum.js";

const QUICK = 8, COARSE = 240; // models of the band and points of a curve while one drags
const SETTLE_MS = 150; // without a move: then all models and points are drawn, and the optimum is found in full
const FREQUENCIES = 160;
const NAMES = ["P", "I", "D", "setpoint_filter_s"];
const short = (x, digits = 3) => (x == null || Number.isNaN(x) ? "-" : Number.isFinite(x) ? Number(x.toPrecision(digits)).toString() : "\u221e");
const percent = (x) => `${(100 * x).toFixed(1)} %`;

export class Tuner {
  // `data` is as of estune.run.results.tuning_data; `live` are the gains to compare with, `act` has
  // what may be done with the rig: `try` gains, and `apply` them once that is confirmed.
  constructor(container, data, live = null, act = null) {
    this.act = act;
    this.data = data;
    this.container = container;
    this.base = live ?? data.gains.tuned ?? data.gains.initial;
    this.baseName = live ? "live gains" : data.gains.tuned ? "tuned gains" : "initial gains";
    this.limits = { ...data.limits };
    this.effort = 0; // decades of the weight of the effort
    this.gains = { ...(data.gains.tuned ?? this.base) };
    this.times = []; // of each move until it is painted, ms
    this.seen = new Set(); // figures in the window
    this.scrolled = new IntersectionObserver((entries) => entries.forEach(({ target, isIntersecting }) => this.seen[isIntersecting ? "add" : "delete"](target)));
    const { sampling_Hz } = data.controller, { samples, step_index } = data.trial;
    this.time = Float64Array.from({ length: samples }, (_, k) => (k - step_index) / sampling_Hz);
    const low = Math.min(0.25 / data.settling_s / 10, sampling_Hz / 40), high = sampling_Hz / 2;
    this.frequencies = Array.from({ length: FREQUENCIES }, (_, n) => low * (high / low) ** (n / (FREQUENCIES - 1)));
    this.angles = this.frequencies.map((f) => (2 * Math.PI * f) / sampling_Hz);
    this.build();
    this.refresh(true);
  }

  // The gains to compare with, once they have changed.
  setLive(live) {
    if (NAMES.every((name) => live[name] === this.base[name])) return;
    this.base = live;
    this.baseName = "live gains";
    this.based = null;
    this.settled();
  }

  close() {
    clearTimeout(this.timer);
    cancelAnimationFrame(this.frame);
    this.scrolled.disconnect();
    Object.values(this.charts).forEach((chart) => chart.close());
    this.container.replaceChildren();
  }

  build() {
    const d = this.data;
    this.sliders = {};
    const slider = (name, label, low, high, get, set, show) => {
      const input = make("input", { type: "range", min: low, max: high, step: "any", id: `tune-${name}` });
      const output = make("output", {});
      output.htmlFor = input.id;
      input.addEventListener("input", (event) => this.move(() => set(Number(input.value)), event.timeStamp));
      this.sliders[name] = () => {
        if (Number(input.value) !== get()) input.value = get();
        if (say(output, show())) input.setAttribute("aria-valuetext", show());
      };
      const tried = make("div", { className: "tried" });
      tried.setAttribute("aria-hidden", "true");
      return make("div", { className: "slider" }, make("label", { htmlFor: input.id }, label), output, input, tried);
    };
    const byLimits = (change) => (value) => { change(value); this.toSolve = true; };
    const limits = make("fieldset", {}, make("legend", {}, "What the loop is to keep"),
      slider("Ms", "robustness: largest Ms", 1.2, 2, () => this.limits.Ms, byLimits((v) => (this.limits.Ms = v)), () => this.limits.Ms.toFixed(2)),
      slider("overshoot", "largest overshoot", 0, 0.3, () => this.limits.overshoot, byLimits((v) => (this.limits.overshoot = v)), () => percent(this.limits.overshoot)),
      slider("effort", "weight of the effort", -2, 2, () => this.effort, byLimits((v) => (this.effort = v)), () => `\u00d7 ${short(10 ** this.effort, 2)}`));
    const gains = make("fieldset", {}, make("legend", {}, "Gains"));
    for (const name of NAMES) {
      if (!(this.gains[name] > 0)) continue;
      const low = Math.log(d.bounds.low[name] ?? this.gains[name] / 100), high = Math.log(d.bounds.high[name] ?? this.gains[name] * 100);
      const row = slider(name, d.labels[name], low, high, () => Math.log(this.gains[name]),
        (v) => { this.gains[name] = Math.exp(v); this.unfinished = this.toSolve = false; }, () => short(this.gains[name], 4));
      for (const one of d.tried) // a dot for each trial
        if (one.gains[name] > 0) {
          const dot = make("i", {});
          dot.style.left = `${(100 * (Math.log(one.gains[name]) - low)) / (high - low)}%`;
          row.lastChild.append(dot);
        }
      gains.append(row);
    }
    const button = (label, act) => { const b = make("button", { type: "button", textContent: label }); b.addEventListener("click", act); return b; };
    this.form = make("select", {}, ...FORMS.map(([name]) => new Option(name, name)));
    this.form.setAttribute("aria-label", "Form of the gains to copy");
    this.said = make("p", { className: "soft" });
    this.said.setAttribute("role", "status");
    this.compare = button("Compare", () => {
      const shown = this.compare.getAttribute("aria-pressed") !== "true";
      this.compare.setAttribute("aria-pressed", String(shown));
      this.settled();
    });
    this.compare.setAttribute("aria-pressed", "true");
    this.buttons = make("div", { className: "buttons" },
      button("Optimum for these limits", () => this.move(() => this.solve({}))), this.compare,
      button("Copy gains", () => this.copy()), this.form);
    if (this.act)
      this.buttons.append(button("Try these gains once", () => {
        if (!this.broken || window.confirm("The model predicts that these gains break a limit. Move the rig with them in one trial?")) this.act.try(this.gains);
      }),
        (this.apply = button("Make these gains live\u2026", () => this.act.apply({ gains: { ...this.gains }, rows: this.rows, heads: [this.baseName, "these gains"],
          limits: `Predicted to keep Ms at most ${short(this.limits.Ms)} and overshoot at most ${percent(this.limits.overshoot)}.` }))), (this.why = make("span", { className: "soft" })));
    this.numbers = make("table", {});
    this.cells = [];
    const figures = make("div", { className: "grid" });
    const figure = () => figures.appendChild(make("figure", {}));
    const s = "time from the step, s", own = { label: "these gains", colour: () => (this.broken ? "amber" : "blue"), width: 1.8 };
    const band = [{ label: "", colour: "none", hidden: true }, { label: "", colour: "none", hidden: true }];
    const base = { label: "compared with", colour: "purple", dash: [8, 3] };
    const tried = { label: "nearest trial, measured", colour: "grey", dash: [1, 4], width: 2 };
    const chart = (x, y, label, more = {}, series = [...band, own, base]) =>
      new Chart(figure(), { height: 210, x, y, label, series, bands: [[1, 2]], ...more });
    this.charts = {
      step: chart(s, d.measurement, "Predicted step response", {}, [...band, own, base, tried, { label: "setpoint", colour: "grey", width: 1 }]),
      effort: chart(s, d.command, "Predicted command", {}, [...band, own, base, tried]),
      load: chart("time from the load, s", d.measurement_deviation, "Predicted response to a load at the plant's input"),
      magnitude: chart("frequency, Hz", "loop gain |L|", "Bode diagram: magnitude of the loop gain", { log: true, logX: true }),
      phase: chart("frequency, Hz", "phase of L, degrees", "Bode diagram: phase of the loop gain", { logX: true }),
    };
    this.nyquist = new Nyquist(figure(), 240);
    for (const one of figures.children) this.scrolled.observe(one);
    this.container.classList.add("tuner");
    this.container.replaceChildren(make("p", { className: "soft" }, d.known),
      make("div", { className: "sides" }, limits, gains), this.buttons, this.said,
      make("div", { className: "wide" }, this.numbers), figures,
      make("p", { className: "soft" }, "Intervals and shades hold the models that fit the records; what a result claims is wider where the records leave more open. Dots below the sliders: gains that were tried. Amber: a limit is broken. The load is half the step, at the plant's input."));
  }

  get weights() {
    const factor = 10 ** this.effort, { cost } = this.data;
    return { ...cost, move: cost.move * factor, effort: cost.effort * factor };
  }

  solve(options) {
    this.gains = optimum(this.data, this.gains, this.limits, this.weights, options);
  }

  // A change by the user, drawn in the next frame with all others until then; the full computation
  // follows at rest.
  move(change, at = performance.now()) {
    this.touched = true;
    change();
    this.begun ??= at;
    clearTimeout(this.timer);
    this.frame ??= requestAnimationFrame(() => this.redraw());
  }

  redraw() {
    const begun = this.begun;
    this.frame = this.begun = null;
    if (this.toSolve) {
      this.solve(QUICK_SEARCH);
      this.unfinished = true; // a long move needs more than one step takes
      this.toSolve = false;
    }
    this.refresh(false);
    afterPaint(() => this.times.push(performance.now() - begun));
    this.timer = setTimeout(() => this.settled(), SETTLE_MS);
  }

  settled() {
    clearTimeout(this.timer);
    if (this.unfinished) this.solve({});
    this.unfinished = false;
    this.refresh(true);
  }

  refresh(full) {
    const d = this.data, own = predict(d, d.models[0], this.gains), base = this.compared().prediction;
    const { charts: c, nyquist } = this, shown = (...ones) => full || ones.some(({ figure }) => this.seen.has(figure));
    const parts = { load: shown(c.load), loop: shown(c.magnitude, c.phase, nyquist), shown };
    const others = d.models.slice(1, full ? undefined : 1 + QUICK).map((model) => this.drawn(model, parts));
    const range = (name) => {
      const values = [own[name], ...others.map((one) => one[name])].filter((x) => !Number.isNaN(x));
      return [Math.min(...values), Math.max(...values)];
    };
    const Ms = range("Ms"), overshoot = range("overshoot");
    const { limits: [low, high] } = d.controller, u = own.u ?? [];
    const effort = u.reduce((m, x) => Math.max(m, Math.abs(x)), 0);
    const saturated = u.some((x) => (high !== null && x + d.rest >= high - 1e-9) || (low !== null && x + d.rest <= low + 1e-9));
    const over = { Ms: own.Ms > this.limits.Ms * (1 + TOLERANCE), overshoot: own.overshoot > this.limits.overshoot + TOLERANCE, effort: saturated };
    this.broken = own.y === null || over.Ms || over.overshoot || over.effort;
    Object.values(this.sliders).forEach((show) => show());
    this.showNumbers(own, base, { Ms, overshoot, effort, over });
    if (this.apply) {
      this.apply.disabled = own.y === null || over.Ms || over.overshoot;
      this.why.textContent = this.apply.disabled ? "The model predicts that these gains break a limit." : "";
    }
    this.every = full ? 1 : Math.ceil(this.time.length / COARSE);
    this.draw(own, others, parts);
  }

  // What the gains to compare with are predicted to do, computed once.
  compared() {
    const model = this.data.models[0];
    return (this.based ??= { prediction: predict(this.data, model, this.base), load: this.afterLoad(model, this.base),
      L: loopGain(this.data, model, this.base, this.angles) });
  }

  // What a model other than the estimate predicts: its margins and curves.
  drawn(model, { load, loop }) {
    const d = this.data, margins = robustness(d, model, this.gains), { setpoint } = columns(d);
    const answer = simulate(d, model, this.gains, { setpoint });
    const peak = Number.isFinite(margins.Ms) ? Math.max(0, Math.max(...answer.y.map((v) => v / d.trial.step_size)) - 1) : Infinity;
    return { ...margins, overshoot: peak, ...answer, load: load && this.afterLoad(model, this.gains), L: loop && loopGain(d, model, this.gains, this.angles) };
  }

  // Response to a load of half the step at the plant's input, in a trial of its own.
  afterLoad(model, gains) {
    const { samples, step_index, step_size } = this.data.trial;
    this.rest ??= new Float64Array(samples);
    this.load ??= new Float64Array(samples).fill(-0.5 * step_size / (this.data.static_gain || 1), step_index);
    return simulate(this.data, model, gains, { setpoint: this.rest, load: this.load }).y;
  }

  showNumbers(own, base, { Ms, overshoot, effort, over }) {
    const d = this.data, unit = d.command_unit;
    const rise = (p) => (p.y ? riseTime(p.y, d.trial, d.controller.sampling_Hz) : NaN);
    const largest = (p) => (p.u ? p.u.reduce((m, x) => Math.max(m, Math.abs(x)), 0) : NaN);
    const between = ([low, high], show) => (show(low) === show(high) ? "" : ` (${show(low)} to ${show(high)})`);
    const time = (t) => (t < 1 ? `${short(1e3 * t)} ms` : `${short(t)} s`);
    const rows = [
      ["rise time, 10 to 90 %", time(rise(base)), time(rise(own))],
      ["overshoot", percent(base.overshoot), percent(own.overshoot) + between(overshoot, percent), over.overshoot],
      ["sensitivity Ms", short(base.Ms), own.y ? short(own.Ms) + between(Ms, short) : "unstable", over.Ms || !own.y],
      ["phase margin", `${short(base.phase_margin_deg, 2)}\u00b0`, `${short(own.phase_margin_deg, 2)}\u00b0`],
      ["largest move of the command", `${short(largest(base))} ${unit}`, `${short(effort)} ${unit}${over.effort ? ", at its limit" : ""}`, over.effort],
      ["cost", short(base.cost), short(own.cost)],
    ];
    this.rows = rows.map((row) => row.slice(0, 3));
    if (!this.cells.length) {
      const cell = (tag, properties) => make(tag, properties), heads = [this.baseName, "these gains"];
      this.heads = heads.map((textContent) => cell("th", { textContent, scope: "col" }));
      this.cells = rows.map(() => [cell("td"), cell("td")]);
      this.numbers.replaceChildren(make("tr", {}, cell("td"), ...this.heads),
        ...rows.map(([name], n) => make("tr", {}, cell("th", { textContent: name, scope: "row" }), ...this.cells[n])));
    }
    say(this.heads[0], this.baseName);
    rows.forEach(([, before, after, warn], n) => {
      say(this.cells[n][0], before);
      say(this.cells[n][1], after);
      this.cells[n][1].classList.toggle("amber", Boolean(warn));
    });
  }

  // Draws what is in the window; all of it at rest.
  draw(own, others, { load, loop, shown }) {
    const d = this.data, { trial } = d, c = this.charts, level = d.preload, { every, based: base } = this;
    const some = (list) => (every === 1 ? list : list.filter((_, k) => k % every === 0)), time = some(this.time);
    const nothing = Array.from(time, () => null), curve = (y, by = 0) => (y ? Array.from(some(y), (v) => v + by) : nothing);
    const isCompared = this.compare.getAttribute("aria-pressed") === "true";
    const only = (list) => (isCompared ? list : list.map(() => null));
    const band = (lists, by = 0) => envelope(lists, time.length, by, every);
    const nearest = this.nearest(), seen = (name) => (nearest ? some(this.resampled(nearest, name)) : nothing);
    const bound = (pair) => (pair ?? []).filter((at) => at !== null && Math.abs(at) < 1e8).map((at) => ({ at, colour: "amber", label: "limit" }));
    const { y, u } = base.prediction, model = d.models[0];
    if (shown(c.step))
      c.step.show([time, ...band(others.map((o) => o.y), level), curve(own.y, level), only(curve(y, level)), seen("y"), curve(columns(d).setpoint, level)],
        [...bound(d.measurement_limits), { at: level + trial.step_size * (1 + this.limits.overshoot), colour: "amber", label: "largest overshoot" }]);
    if (shown(c.effort))
      c.effort.show([time, ...band(others.map((o) => o.u), d.rest), curve(own.u, d.rest), only(curve(u, d.rest)), seen("u")], bound(d.controller.limits));
    if (load)
      c.load.show([time, ...band(others.map((o) => o.load)), curve(own.y && this.afterLoad(model, this.gains)), only(curve(y && base.load))]);
    if (!loop) return;
    const L = loopGain(d, model, this.gains, this.angles), B = base.L, count = this.frequencies.length;
    const magnitude = ({ re, im }) => Array.from(re, (x, n) => Math.hypot(x, im[n]));
    if (shown(c.magnitude))
      c.magnitude.show([this.frequencies, ...envelope(others.map((o) => magnitude(o.L)), count), magnitude(L), only(magnitude(B))], [{ at: 1, colour: "grey" }]);
    if (shown(c.phase)) {
      const main = phase(L), near = others.map((o) => main.map((at, n) => at + turned(o.L, L, n)));
      c.phase.show([this.frequencies, ...envelope(near, count), main, only(phase(B))], [{ at: -180, colour: "grey" }], { y: [-450, 0] });
    }
    if (shown(this.nyquist))
      this.nyquist.show([...others.slice(0, 15).map((o) => ({ ...o.L, colour: "blue", width: 1, faint: true })),
        ...(isCompared ? [{ ...B, colour: "purple", width: 1.4, dash: [8, 3] }] : []), { ...L, colour: this.broken ? "amber" : "blue", width: 1.8 }], this.limits.Ms);
  }

  // The trial whose gains are nearest to these, among those whose response is here.
  nearest() {
    const away = ({ gains }) => NAMES.reduce((sum, name) => sum + (gains[name] > 0 && this.gains[name] > 0 ? Math.log(gains[name] / this.gains[name]) ** 2 : 0), 0);
    return this.data.tried.filter((one) => one.y).reduce((best, one) => (best && away(best) <= away(one) ? best : one), null);
  }

  resampled({ every, ...one }, name) {
    return Array.from(this.time, (_, k) => (k % every ? null : one[name][k / every] ?? null));
  }

  async copy() {
    const text = written(this.form.value, this.gains, this.data);
    try {
      await navigator.clipboard.writeText(text);
      this.said.textContent = `copied: ${text}`;
    } catch { // without leave to use the clipboard the text can be selected
      this.said.textContent = text;
    }
  }
}

const QUICK_SEARCH = { evaluations: 40, size: 0.15, time_ms: 10 }; // the rest of a move is drawing

// Calls a function once the browser has painted what was drawn in this frame.
function afterPaint(call) {
  const { port1, port2 } = new MessageChannel();
  port1.onmessage = () => { port1.close(); call(); };
  port2.postMessage(0);
}

// Sets a text that is another one; whether it was.
function say(node, text) {
  const isNew = node.textContent !== text;
  if (isNew) node.textContent = text;
  return isNew;
}

// Lowest and highest of several curves at each point; nothing without curves.
function envelope(lists, count, by = 0, every = 1) {
  const low = new Array(count).fill(null), high = new Array(count).fill(null);
  if (lists.length)
    for (let k = 0; k < count; k++) {
      let least = Infinity, most = -Infinity;
      for (const list of lists) {
        const at = list[k * every];
        if (at < least) least = at;
        if (at > most) most = at;
      }
      if (Number.isFinite(least) && Math.abs(most) < 1e12) [low[k], high[k]] = [least + by, most + by];
    }
  return [high, low];
}

const degrees = (x) => (x * 180) / Math.PI;

// Phase in degrees without jumps, from that of the lowest frequency on.
function phase({ re, im }) {
  let turns = 0, before = null;
  return Array.from(re, (x, n) => {
    const at = degrees(Math.atan2(im[n], x));
    if (before === null) turns = at > 0 ? -360 : 0;
    else if (at - before > 180) turns -= 360;
    else if (before - at > 180) turns += 360;
    before = at;
    return at + turns;
  });
}

// Angle of one loop gain relative to another, degrees.
const turned = (one, other, n) => degrees(Math.atan2(one.im[n] * other.re[n] - one.re[n] * other.im[n], one.re[n] * other.re[n] + one.im[n] * other.im[n]));

// Time from 10 % to 90 % of the step, s.
function riseTime(y, { step_index, step_size }, sampling_Hz) {
  const first = (share) => {
    for (let k = step_index; k < y.length; k++)
      if (y[k] / step_size >= share) {
        const before = k > step_index ? y[k - 1] / step_size : 0;
        return k - (y[k] / step_size - share) / (y[k] / step_size - before || 1);
      }
    return NaN;
  };
  return (first(0.9) - first(0.1)) / sampling_Hz;
}
