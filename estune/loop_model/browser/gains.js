// Gains in the forms that other controllers take, as in estune.core.gain_forms.

const digits = (x) => Number(x.toPrecision(6)).toString();
const listed = (values) => Object.entries(values).map(([name, value]) => `${name} = ${digits(value)}`).join(", ");

function standard({ P, I, D }) {
  return { Kp: P, Ti_s: I > 0 ? P / I : Infinity, Td_s: D / P };
}

function series(gains) {
  const { Kp, Ti_s, Td_s } = standard(gains);
  if (Ti_s < 4 * Td_s) return "there is no series form: Ti is below 4 Td";
  const share = Ti_s === Infinity ? 1 : 0.5 * (1 + Math.sqrt(1 - (4 * Td_s) / Ti_s));
  return listed({ Kp: Kp * share, Ti_s: Ti_s * share, Td_s: Td_s / share });
}

export const FORMS = [
  ["P, I, D", (g) => listed(g)],
  ["Kp, Ti, Td", (g) => `${listed(standard(g))}, setpoint_filter_s = ${digits(g.setpoint_filter_s)}`],
  ["series", (g) => `${series(g)}, setpoint_filter_s = ${digits(g.setpoint_filter_s)}`],
  ["C", (g, d) => [`/* u = P e + I int(e) - D dy/dt, derivative filter ${digits(d.controller.derivative_filter_s)} s, ${digits(d.controller.sampling_Hz)} Hz */`,
    ...Object.entries(g).map(([name, value]) => `static const double ${name} = ${digits(value)};`)].join("\n")],
  ["TOML", (g) => ["[gains]", ...Object.entries(g).map(([name, value]) => `${name} = ${digits(value)}`)].join("\n")],
];

// The gains in a form of `FORMS`, as text.
export const written = (form, { P, I, D, setpoint_filter_s }, data) =>
  FORMS.find(([name]) => name === form)[1]({ P, I, D, setpoint_filter_s }, data);
