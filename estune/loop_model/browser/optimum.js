// The gains of least predicted cost within limits of Ms and overshoot, by the method of Nelder and
// Mead in the logarithms of the tuned gains.

import { predict } from "./loop.js";

export const TOLERANCE = 2e-3; // excess over a limit that counts as kept; the search aims at the limit itself
const PENALTY = 30, UNSTABLE = 100;

// How much worse than nothing some gains are: the log cost, and what they exceed of the limits.
function score(problem, gains, limits, weights) {
  const p = predict(problem, problem.models[0], gains, weights, "search");
  if (!Number.isFinite(p.cost)) return UNSTABLE;
  const excess = [Math.log(p.Ms / limits.Ms), p.overshoot - limits.overshoot];
  if (limits.phase_margin_deg) excess.push(((limits.phase_margin_deg - p.phase_margin_deg) * Math.PI) / 180);
  return Math.log(p.cost) + PENALTY * excess.reduce((sum, x) => sum + Math.max(x, 0), 0);
}

// Searches from `start` with at most `evaluations` predictions, within `time_ms`; returns gains.
export function optimum(problem, start, limits, weights, { evaluations = 400, size = 0.4, time_ms = Infinity } = {}) {
  const end = performance.now() + time_ms;
  const names = problem.tuned, { low, high } = problem.bounds;
  const gainsOf = (x) => ({ ...start, ...Object.fromEntries(names.map((name, n) => [name, Math.exp(x[n])])) });
  const clip = (x) => x.map((v, n) => Math.min(Math.max(v, Math.log(low[names[n]])), Math.log(high[names[n]])));
  let left = evaluations;
  const point = (x) => { left = performance.now() < end ? left - 1 : 0; const at = clip(x); return { x: at, f: score(problem, gainsOf(at), limits, weights) }; };
  const centre = names.map((name) => Math.log(start[name]));
  let best = point(centre);
  while (left > 0) {
    const before = best.f;
    let simplex = [best, ...names.map((_, n) => point(best.x.map((v, m) => v + (m === n ? size : 0))))];
    while (left > 0) {
      simplex.sort((p, q) => p.f - q.f);
      const worst = simplex[simplex.length - 1];
      if (worst.f - simplex[0].f < 1e-5) break;
      const rest = simplex.slice(0, -1), mean = names.map((_, n) => rest.reduce((sum, p) => sum + p.x[n], 0) / rest.length);
      const along = (t) => point(mean.map((m, n) => m + t * (worst.x[n] - m)));
      let next = along(-1);
      if (next.f < simplex[0].f) { const further = along(-2); if (further.f < next.f) next = further; }
      else if (next.f >= rest[rest.length - 1].f) next = along(next.f < worst.f ? -0.5 : 0.5);
      if (next.f < worst.f) simplex[simplex.length - 1] = next;
      else simplex = [simplex[0], ...simplex.slice(1).map((p) => point(p.x.map((v, n) => 0.5 * (v + simplex[0].x[n]))))];
    }
    best = simplex.reduce((p, q) => (q.f < p.f ? q : p));
    if (before - best.f < 1e-4) break;
    size = 0.5 * size; // again from the best: a simplex may have collapsed on a limit
  }
  return gainsOf(best.x);
}
