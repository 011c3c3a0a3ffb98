// The page of a diagnosis: records, how they are understood, the model, the verdict.

import { Chart, make } from "./charts.js";

const POLL_MS = 500;
const $ = (id) => document.getElementById(id);
const key = new URLSearchParams(location.hash.slice(1)).get("key") ?? sessionStorage.getItem("explain-key");
if (key) {
  sessionStorage.setItem("explain-key", key);
  history.replaceState(null, "", location.pathname); // not into bookmarks
}
const row = (tag, cells) => make("tr", {}, ...cells.map((cell) => make(tag, {}, cell ?? "")));
const number = (x) => Number(x.toPrecision(4)).toString();

// The answer to a request; a mistake is shown as a sentence, and nothing comes back. `refuse` shows
// one that belongs to what was filled in.
async function ask(path, options = {}, refuse = (error) => { $("message").textContent = error; }) {
  $("message").textContent = "";
  let answer;
  try {
    answer = await fetch(path, { ...options, headers: { Authorization: `Bearer ${key}` } });
  } catch {
    $("message").textContent = "The page's server does not answer; start it again: estune explain-page";
    return null;
  }
  const content = await answer.json();
  if (content.error) refuse(content.error);
  return content.error ? null : content;
}
const act = (name, given = {}, refuse) => ask(`api/act/${name}`, { method: "POST", body: JSON.stringify(given) }, refuse);

let charts = [], records = null;

async function send(files) {
  for (const file of files) {
    $("message").textContent = `${file.name} is being copied`;
    if (!(await ask(`api/file/${encodeURIComponent(file.name)}`, { method: "POST", body: file }))) return;
  }
  await read();
}

async function read() {
  const answer = await ask("api/records");
  if (!answer) return;
  records = answer;
  $("understood").hidden = false;
  $("fault").hidden = !records.fault;
  $("fault").textContent = records.fault;
  const ranges = [...new Set(records.records.flatMap((one) => Object.keys(one.ranges)))];
  const shown = ([low, high]) => `${number(low)} to ${number(high)}`;
  $("list").replaceChildren(...(records.records.length ? [row("th", ["record", "rate, Hz", "length, s", "loop", ...ranges])] : []),
    ...records.records.map((one) => row("td", [one.name, number(one.sampling_Hz), number(one.duration_s), one.ranges.setpoint_N ? one.loop : "-",
      ...ranges.map((name) => (one.ranges[name] ? shown(one.ranges[name]) : ""))])));
  $("findings").replaceChildren(...records.findings.map((text) => make("li", { textContent: text })));
  drawMapping();
  $("mapping").open = Boolean(records.fault);
  $("which").hidden = !records.curves?.length;
  $("which").querySelector("select").replaceChildren(...(records.curves ?? []).map((one) => new Option(one.name)));
  drawCurves();
}

function drawCurves() {
  charts.forEach((chart) => chart.close());
  const curve = records.curves?.[$("which").querySelector("select").selectedIndex], figures = $("curves");
  figures.replaceChildren();
  charts = Object.keys(curve ?? {}).filter((name) => !["name", "time_s"].includes(name)).map((name) => {
    const [what, unit] = [name.slice(0, name.lastIndexOf("_")), name.slice(name.lastIndexOf("_") + 1)];
    const y = `${what}, ${unit}`, figure = figures.appendChild(make("figure"));
    const chart = new Chart(figure, { height: 170, x: "time, s", y, legend: false, label: `${y} over time in ${curve.name}`, series: [{ label: y, colour: "blue" }] });
    chart.show([curve.time_s, curve[name]]);
    return chart;
  });
}

// For each column of a record, the file's own column, its unit and a factor.
function drawMapping() {
  const options = (list) => [new Option("as named", ""), ...list.map((one) => new Option(one, one))];
  const now = Object.fromEntries(records.sources.map((one) => [one.column, one]));
  const field = (name, part, node) => Object.assign(node, { name: `${name} ${part}` });
  const kept = $("mapping").querySelector("form");
  const value = (name, part) => records.map[name]?.[part] ?? "";
  const rows = records.columns.map((name) => {
    const from = field(name, "from", make("select", {}, ...options(records.channels.map((one) => one.name))));
    const unit = field(name, "unit", make("select", {}, ...options(records.units)));
    const scale = field(name, "scale", make("input", { inputMode: "decimal", placeholder: "1", autocomplete: "off" }));
    [["from", from], ["unit", unit], ["scale", scale]].forEach(([part, node]) => {
      node.value = value(name, part);
      node.setAttribute("aria-label", `${part} of ${name}`);
    });
    const taken = now[name];
    return row("td", [name, from, unit, scale, taken ? `${taken.channel}${taken.unit ? `, ${taken.unit}` : ""}` : "none"]);
  });
  kept.querySelector("table").replaceChildren(row("th", ["column", "comes from", "in the unit", "times", "taken now from"]), ...rows);
}

async function mapped(event) {
  event.preventDefault();
  const columns = {};
  for (const { name, value } of event.target.elements) {
    if (!name || !value) continue;
    const [column, part] = name.split(" ");
    (columns[column] ??= {})[part] = value;
  }
  if (await act("columns", { columns })) await read();
}

async function openForm() {
  const kinds = await ask("api/form"); // by its declarations
  if (!kinds) return;
  const draw = () => {
    const kind = kinds[$("kind").selectedIndex];
    const write = () => {
      const number = (x) => (Number.isFinite(+x) || /^[-+]?inf$/.test(x) ? x.replace(/\.(?!\d)/, ".0") : JSON.stringify(x)); // else the whole file were no TOML
      const numbers = (x) => `[${x.replace(/^\[|\]$/g, "").split(/[,;\s]+/).filter(Boolean).map(number).join(", ")}]`;
      const text = { number, numbers, text: JSON.stringify, flag: (x) => x, toml: (x) => x };
      const given = kind.keys.flatMap(({ name, form }) => {
        const value = $(`key-${name}`).value.trim();
        return value ? [`${name} = ${text[form](value)}`] : [];
      });
      $("toml").value = [`[${kind.table}]`, ...given, ""].join("\n");
    };
    $("needs").textContent = kind.needs ? `With no key given: ${kind.needs}.` : "Every key has a default, which is shown.";
    $("keys").replaceChildren(...kind.keys.map(({ name, form, default: otherwise }) => {
      const input = form === "flag" ? make("select", {}, new Option(""), new Option("true"), new Option("false")) : make("input", { placeholder: otherwise === "" ? { numbers: "1, 2.5", toml: "TOML" }[form] ?? "" : String(otherwise), autocomplete: "off" });
      Object.assign(input, { id: `key-${name}` });
      input.addEventListener("input", write);
      return make("div", { className: "field" }, make("label", { htmlFor: input.id }, name), input);
    }));
    write();
  };
  $("kind").replaceChildren(...kinds.map((one) => new Option(one.table.replaceAll("_", " "))));
  $("kind").onchange = draw;
  draw();
}

// Shows what is wrong with a model beside the fields that are named, and the rest above the button.
function refuseModel(error, form) {
  form.querySelectorAll(".wrong").forEach((one) => one.remove());
  const wrong = (textContent) => make("small", { className: "wrong", textContent });
  for (const line of error.split("\n")) {
    const [, key, why] = line.match(/\] (\w+): (.*)/) ?? [], input = key && $(`key-${key}`);
    if (input && form.contains(input)) input.after(wrong(why));
    else form.querySelector("button").before(wrong(line.replace(/^\S*model\.toml: /, "")));
  }
  form.querySelector("input ~ .wrong")?.previousElementSibling.focus();
}

async function useModel(given, form) {
  form.querySelectorAll(".wrong").forEach((one) => one.remove());
  if (await act("model", given, (error) => refuseModel(error, form))) {
    await follow();
    if (records) await read(); // its drum may turn units
  }
}

// The state of the search, again and again while it runs.
async function follow() {
  const state = await ask("api/state");
  if (!state) return null;
  const running = state.state === "running";
  $("model").textContent = state.model ? `Model: ${state.model}` : "No model yet.";
  $("begin").hidden = running;
  $("stop").hidden = $("bar").hidden = !running;
  $("bar").value = state.percent ?? 0;
  $("progress").textContent = running ? `${state.percent} %: ${state.phase}`
    : state.state === "failed" ? state.reason : state.state === "stopped" ? "The search was stopped." : "";
  $("result").hidden = state.state !== "done";
  if (state.state === "done") show(state);
  if (running) setTimeout(follow, POLL_MS);
  return state;
}

function show({ result, command, toml, report, improved }) {
  $("heading").textContent = result.heading;
  $("heading").className = `lead ${["named", "none"].includes(result.verdict) ? "yes" : "no"}`;
  $("again").textContent = command;
  $("save").hidden = !toml;
  $("save").href = `data:text/plain;charset=utf-8,${encodeURIComponent(toml)}`;
  $("save").title = `It is ${improved} already.`;
  $("open").href = report;
  $("report").src = report;
}

$("files").addEventListener("change", (event) => send(event.target.files));
for (const [name, over] of [["dragover", true], ["dragleave", false], ["drop", false]])
  $("drop").addEventListener(name, (event) => { event.preventDefault(); $("drop").classList.toggle("over", over); });
$("drop").addEventListener("drop", (event) => send(event.dataTransfer.files));
$("folder").addEventListener("submit", async (event) => {
  event.preventDefault();
  if (await act("folder", { path: $("path").value })) await read();
});
$("which").addEventListener("change", drawCurves);
$("mapping").querySelector("form").addEventListener("submit", mapped);
$("named").addEventListener("submit", (event) => { event.preventDefault(); useModel({ reference: $("reference").value }, event.target); });
$("described").addEventListener("toggle", () => { if ($("described").open && !$("kind").length) openForm(); });
$("described").querySelector("form").addEventListener("submit", (event) => { event.preventDefault(); useModel({ toml: $("toml").value }, event.target); });
$("begin").addEventListener("click", async () => { if (await act("begin")) follow(); });
$("stop").addEventListener("click", async () => { if (await act("stop")) follow(); });
$("copy").addEventListener("click", () => navigator.clipboard.writeText($("again").textContent));
$("path").value = "";
follow().then((state) => state?.data && read()); // records given in the terminal
