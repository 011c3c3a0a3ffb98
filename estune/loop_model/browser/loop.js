// Prediction of a step trial by a model of the loop, as in estune.loop_model: response, cost, Ms.
//
// A model is y = G u, G = q^-(d+1) B / (A1 A2 ...), with B and each section A in powers of 1 - q^-1.
// The controller is R u = T F r - S y; S and T are sums over P, I, D and I D / P.

const FEATURES = (g) => [g.P, g.I, g.D, (g.I * g.D) / g.P];
const GRID_POINTS = 250, LOWEST = 1e-4, PER_TURN = 24, ZOOMED = 25;

// The controller's polynomials in q^-1 with some gains.
function controller(c, gains) {
  const weights = FEATURES(gains);
  const sum = (basis) => basis[0].map((_, n) => basis.reduce((total, row, k) => total + weights[k] * row[n], 0));
  const h = 1 / c.sampling_Hz, lag = gains.setpoint_filter_s;
  let a = Math.exp(-h / Math.max(lag, 1e-12)), F = [1 - a, 0];
  if (c.setpoint_filter === "backward" && lag) F = [1 - (a = lag / (lag + h)), 0];
  if (c.setpoint_filter === "tustin" && lag) {
    a = (2 * lag - h) / (2 * lag + h);
    F = [(1 - a) / 2, (1 - a) / 2];
  }
  return { S: sum(c.S), T: sum(c.T), R: c.R, F, a };
}

// A controller that starts at rest: a function of setpoint and measurement that gives the effort.
// estune's own form takes the excess over its limits out of the integral; others run on the
// limited efforts of the past.
function controlLaw(c, gains, rest) {
  const low = (c.limits[0] ?? -Infinity) - rest, high = (c.limits[1] ?? Infinity) - rest;
  const { S, T, R, F, a } = controller(c, gains);
  if (c.own) {
    const h = 1 / c.sampling_Hz, tracking = Math.min(1, (h * gains.I) / gains.P), span = c.derivative_filter_s + h;
    let integral = 0, filtered = 0, low_passed = 0;
    return (setpoint, y) => {
      filtered = a * filtered + (1 - a) * setpoint;
      const error = filtered - y, derivative = (y - low_passed) / span;
      const wanted = gains.P * error + integral - gains.D * derivative;
      const effort = Math.min(Math.max(wanted, low), high);
      integral += gains.I * h * error - tracking * (wanted - effort);
      low_passed += h * derivative;
      return effort;
    };
  }
  const us = R.map(() => 0), rs = T.map(() => 0), ys = S.map(() => 0);
  let before = 0, filtered = 0;
  const shift = (list, value) => { list.pop(); list.unshift(value); };
  return (setpoint, y) => {
    filtered = a * filtered + F[0] * setpoint + F[1] * before;
    before = setpoint;
    shift(rs, filtered);
    shift(ys, y);
    let effort = 0;
    for (let n = 0; n < T.length; n++) effort += T[n] * rs[n];
    for (let n = 0; n < S.length; n++) effort -= S[n] * ys[n];
    for (let n = 1; n < R.length; n++) effort -= R[n] * us[n - 1];
    effort = Math.min(Math.max(effort, low), high);
    shift(us, effort);
    return effort;
  };
}

// Numbers that the next call for the same name overwrites: a search makes thousands of responses.
const spares = {};
const spare = (name, n) => (spares[name]?.length === n ? spares[name] : (spares[name] = new Float64Array(n)));

// Output and effort of the loop as deviations from rest, for columns of setpoint, load and noise;
// in numbers of their own, or in spare ones of a name.
export function simulate(problem, model, gains, { setpoint, load, noise }, limited = true, name = "") {
  const n = setpoint.length, made = (of) => (name ? spare(`${of} ${name}`, n) : new Float64Array(n));
  const y = made("y"), u = made("u");
  const c = limited ? problem.controller : { ...problem.controller, limits: [null, null] };
  const act = controlLaw(c, gains, problem.rest);
  const sections = model.sections.map((p) => ({ p, unit: p[0] + p[1] + p[2], x: 0, dx: 0 }));
  const B = model.numerator, dead = model.dead_samples, past = spare("past", n + dead + B.length + 1).fill(0);
  const differences = new Float64Array(B.length), friction = model.friction ?? 0;
  const origin = dead + B.length; // past[k + origin] is the plant's last state at sample k
  for (let k = 0; k < n; k++) {
    // B at the state d + 1 samples ago: its backward differences, of all orders.
    for (let m = 0; m < B.length; m++) differences[m] = past[k - 1 - dead - m + origin];
    let output = 0;
    for (let m = 0; m < B.length; m++) {
      output += B[m] * differences[0];
      for (let j = 0; j < B.length - 1 - m; j++) differences[j] -= differences[j + 1];
    }
    y[k] = output;
    u[k] = act(setpoint[k], output + (noise ? noise[k] : 0));
    let signal = u[k] + (load ? load[k] : 0);
    for (let m = 0; m < sections.length; m++) {
      const s = sections[m];
      let step = (signal - s.p[0] * s.x + s.p[2] * s.dx) / s.unit;
      if (m === 0 && friction) step -= Math.min(Math.max(step, -friction), friction);
      s.dx = step;
      s.x += step;
      signal = s.x;
    }
    past[k + origin] = signal;
  }
  return { y, u };
}

// Angles up to half the sampling rate, finer for the dead time of a model and about its resonances.
function grid(model) {
  if (model.angles) return model.angles;
  const dead = model.dead_samples;
  const turns = (PER_TURN * (dead + 2)) >> 1, theta = [];
  for (let n = 0; n < GRID_POINTS; n++) theta.push(LOWEST * (Math.PI / LOWEST) ** (n / (GRID_POINTS - 1)));
  for (let n = 1; n < turns; n++) theta.push((Math.PI * n) / (turns - 1));
  for (const [c0, c1, c2] of model.sections) {
    const a1 = -(c1 + 2 * c2), angle = Math.acos(-a1 / (2 * Math.sqrt(c2))); // NaN of real poles
    for (let n = -1; n < 7.5 && angle; n += 0.5) {
      for (const side of [-1, 1]) theta.push(angle + side * 2 ** n * Math.max(-0.5 * Math.log(c2), 1e-6));
    }
    if (angle) theta.push(angle);
  }
  theta.sort((x, y) => x - y);
  const inside = theta.filter((x, n) => x >= LOWEST && x <= Math.PI && (!n || x - theta[n - 1] > 1e-12));
  return (model.angles = Float64Array.from(inside));
}

const mul = (x, y) => [x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]];
const div = (x, y) => { const d = y[0] * y[0] + y[1] * y[1]; return [(x[0] * y[0] + x[1] * y[1]) / d, (x[1] * y[0] - x[0] * y[1]) / d]; };
function at(coefficients, z) { // Horner
  let value = [coefficients[coefficients.length - 1], 0];
  for (let n = coefficients.length - 2; n >= 0; n--) { value = mul(value, z); value[0] += coefficients[n]; }
  return value;
}

// G of a model and its product of sections, at an angle.
function plantAt(model, theta) {
  const later = [Math.cos(theta), -Math.sin(theta)];
  const half = Math.sin(theta / 2), difference = [2 * half * half, Math.sin(theta)]; // 1 - q^-1 with all its digits
  let A = [1, 0];
  for (const section of model.sections) A = mul(A, at(section, difference));
  const turn = -theta * (model.dead_samples + 1);
  const G = div(mul([Math.cos(turn), Math.sin(turn)], at(model.numerator, difference)), A);
  return { later, difference, A, G };
}

// What a model is at given angles, computed once: G, its product of sections, R and q^-1.
function known(problem, model, name, angles) {
  const kept = (model.known ??= {});
  return kept[name]?.angles === angles ? kept[name] : (kept[name] = evaluated(problem, model, angles));
}

function evaluated(problem, model, angles) {
  const columns = ["cos", "sin", "Gr", "Gi", "Ar", "Ai", "Rr", "Ri"];
  const k = { angles, ...Object.fromEntries(columns.map((c) => [c, new Float64Array(angles.length)])) };
  angles.forEach((theta, n) => {
    const { later, A, G } = plantAt(model, theta);
    [k.cos[n], k.sin[n]] = later;
    [k.Gr[n], k.Gi[n]] = G;
    [k.Ar[n], k.Ai[n]] = A;
    [k.Rr[n], k.Ri[n]] = at(problem.controller.R, later);
  });
  return k;
}

// The loop gain G S / R at known angles: lists of real and imaginary parts.
function gainOf(k, S, re = new Float64Array(k.angles.length), im = new Float64Array(k.angles.length)) {
  const count = k.angles.length, top = S.length - 1;
  for (let n = 0; n < count; n++) {
    let sr = S[top], si = 0;
    for (let m = top - 1; m >= 0; m--) [sr, si] = [sr * k.cos[n] - si * k.sin[n] + S[m], sr * k.sin[n] + si * k.cos[n]];
    const nr = k.Gr[n] * sr - k.Gi[n] * si, ni = k.Gr[n] * si + k.Gi[n] * sr, d = k.Rr[n] ** 2 + k.Ri[n] ** 2;
    re[n] = (nr * k.Rr[n] + ni * k.Ri[n]) / d;
    im[n] = (ni * k.Rr[n] - nr * k.Ri[n]) / d;
  }
  return { re, im };
}

// The loop gain at angles in rad/sample, the same list each time.
export function loopGain(problem, model, gains, angles) {
  return gainOf(known(problem, model, "shown", angles), controller(problem.controller, gains).S);
}

// Ms and the phase margin in degrees; infinite and NaN where the loop is unstable: where its
// characteristic polynomial turns about the origin, or is not above zero at q^-1 = 1.
export function robustness(problem, model, gains) {
  const k = known(problem, model, "grid", grid(model));
  const { S } = controller(problem.controller, gains), count = k.angles.length;
  const { re, im } = gainOf(k, S, spare("re", count), spare("im", count)), size = spare("size", count);
  let least = 0, total = 0, margin = Infinity, cr = 1, ci = 0;
  for (let n = 0; n < re.length; n++) {
    const pr = k.Ar[n] * k.Rr[n] - k.Ai[n] * k.Ri[n], pi = k.Ar[n] * k.Ri[n] + k.Ai[n] * k.Rr[n];
    const br = 1 + re[n], xr = br * pr - im[n] * pi, xi = br * pi + im[n] * pr;
    total += Math.atan2(xi * cr - xr * ci, xr * cr + xi * ci); // the angle since the last point
    [cr, ci] = [xr, xi];
    size[n] = Math.hypot(br, im[n]);
    if (size[n] < size[least]) least = n;
    if (!n) continue;
    const now = Math.hypot(re[n], im[n]), before = Math.hypot(re[n - 1], im[n - 1]);
    if (before > 1 === now > 1) continue;
    const share = Math.log(before) / (Math.log(before) - Math.log(now));
    const step = Math.atan2(im[n] * re[n - 1] - re[n] * im[n - 1], re[n] * re[n - 1] + im[n] * im[n - 1]);
    margin = Math.min(margin, Math.abs(Math.atan2(-im[n - 1], -re[n - 1]) + share * step));
  }
  const wrong = gains.I && model.numerator[0] * S.reduce((sum, s) => sum + s, 0) <= 0;
  if (wrong || !Number.isFinite(total) || Math.abs(total) > Math.PI / 2) return { Ms: Infinity, phase_margin_deg: NaN };
  return { Ms: 1 / zoomed(problem, model, S, k.angles, size, least), phase_margin_deg: (margin * 180) / Math.PI };
}

// The least |1 + L| by a second grid about that of the first.
function zoomed(problem, model, S, angles, size, n) {
  if (!(n > 0 && n < size.length - 1)) return size[n];
  const near = Float64Array.from({ length: ZOOMED }, (_, m) => angles[n - 1] + ((angles[n + 1] - angles[n - 1]) * m) / (ZOOMED - 1));
  const { re, im } = gainOf(evaluated(problem, model, near), S), values = re.map((x, m) => Math.hypot(1 + x, im[m]));
  return refined(values, values.indexOf(Math.min(...values)));
}

// Minimum of a parabola through the logarithms of the least value and its neighbours.
function refined(values, n) {
  if (!(n > 0 && n < values.length - 1 && values[n] > 0)) return values[n];
  const [left, middle, right] = [values[n - 1], values[n], values[n + 1]].map(Math.log);
  const bend = left - 2 * middle + right;
  return bend > 0 ? Math.exp(middle - (left - right) ** 2 / (8 * bend)) : values[n];
}

// The columns of the trial; they depend on the problem alone.
export function columns(problem) {
  if (problem.columns) return problem.columns;
  const { samples, step_index, step_size, ramp, load_size, load_index } = problem.trial;
  const setpoint = Float64Array.from({ length: samples }, (_, k) => step_size * Math.min(1, Math.max(0, (k - step_index + 1) / ramp)));
  const load = new Float64Array(samples).fill(load_size, load_size ? load_index : samples);
  return (problem.columns = { setpoint, load });
}

// What is to be expected of a trial with some gains; cost and Ms are infinite where it is unstable.
// Response and effort are in spare numbers of a name where one is given.
export function predict(problem, model, gains, weights = problem.cost, name = "") {
  const margins = robustness(problem, model, gains);
  if (!Number.isFinite(margins.Ms)) return { ...margins, cost: Infinity, overshoot: Infinity, y: null, u: null };
  const { setpoint, load } = columns(problem), { trial } = problem;
  const { y, u } = simulate(problem, model, gains, { setpoint, load }, true, name);
  let peak = -Infinity;
  const end = trial.load_size ? trial.load_index : trial.samples;
  for (let k = trial.step_index; k < end; k++) peak = Math.max(peak, y[k] / trial.step_size);
  return { ...margins, y, u, overshoot: Math.max(peak - 1, 0), cost: cost(problem, model, gains, y, u, weights) };
}

// The cost with the share that noise has in it: by its variance where the cost is quadratic, else
// as the mean over one sequence of noise and its negative.
function cost(problem, model, gains, y, u, weights) {
  const { setpoint } = columns(problem), { noise_std: sd, noise } = problem;
  if (weights.unknown) return NaN;
  const plain = () => ofColumns(problem, weights, y, u);
  if (!sd) return plain();
  if (noise) {
    const scaled = Float64Array.from(noise, (x) => sd * x);
    const moved = simulate(problem, model, gains, { setpoint: new Float64Array(setpoint.length), noise: scaled }, false);
    const shifted = (sign) => ofColumns(problem, weights, y.map((v, k) => v + sign * (moved.y[k] + scaled[k])), u.map((v, k) => v + sign * moved.u[k]));
    return 0.5 * (shifted(1) + shifted(-1));
  }
  const after = problem.trial.samples - problem.trial.step_index;
  const { noise: impulse } = (problem.impulse ??= { setpoint: new Float64Array(after), noise: new Float64Array(after).fill(1, 0, 1) });
  const answer = simulate(problem, model, gains, problem.impulse, false, "noise");
  let error = 0, move = answer.u[0] ** 2;
  for (let k = 0; k < after; k++) {
    error += (answer.y[k] + impulse[k]) ** 2;
    if (k) move += (answer.u[k] - answer.u[k - 1]) ** 2;
  }
  const total = weights.error.reduce((sum, w) => sum + w, 0);
  return plain() + (sd / problem.trial.step_size) ** 2 * (total * error + weights.move * after * move);
}

function ofColumns(problem, weights, y, u) {
  const { setpoint } = columns(problem), { trial } = problem, { step_index: from, step_size } = trial;
  const end = trial.load_size ? trial.load_index : trial.samples;
  const size = weights.absolute ? Math.abs : (x) => x * x;
  let eta = 0, rejected = 0, moves = 0, used = 0;
  for (let k = from; k < end; k++) eta += weights.error[k - from] * size((setpoint[k] - y[k]) / step_size);
  if (weights.rejection) {
    for (let k = trial.load_index; k < trial.samples; k++) rejected += weights.load_error[k - trial.load_index] * size((setpoint[k] - y[k]) / trial.load_size);
    eta = (1 - weights.rejection) * eta + weights.rejection * rejected;
  }
  if (weights.effort) {
    const last = Math.max(1, Math.floor((end - from) / 10));
    let rest = 0;
    for (let k = end - last; k < end; k++) rest += u[k] / last;
    for (let k = from; k < end; k++) used += ((u[k] - rest) / step_size) ** 2;
  }
  for (let k = from; k < trial.samples; k++) moves += ((u[k] - (u[k - 1] ?? 0)) / step_size) ** 2;
  return eta + weights.effort * used + weights.move * moves;
}
