// The page: follows one view by server-sent events, and draws what has changed.

import { make } from "./charts.js";
import { openForm } from "./form.js";
import { LabelForm } from "./labels.js";
import { RunTable } from "./runs.js";
import { Sections } from "./sections.js";
import { TuningSection } from "./tuning.js";

const STALE_S = 1.5; // the rig is read four times a second
const AGAIN_S = 10; // a stream that is silent for so long is opened anew: the computer has slept
const $ = (id) => document.getElementById(id);
const key = new URLSearchParams(location.hash.slice(1)).get("key") ?? sessionStorage.getItem("key");
if (key) {
  sessionStorage.setItem("key", key);
  history.replaceState(null, "", location.pathname + location.search); // not into bookmarks
}

let stream = null, view = "", shown = null;
let beat = { at: performance.now(), ages: {} };
const tuning = new TuningSection(), runs = new RunTable();
const labels = new LabelForm((given) => command("label", given));
runs.onLaidOver = (names) => shown.layOver(names);
export const sections = () => shown; // of the view on the page
let allowed = [], kind = "";

function text(node, value) {
  if (node.textContent !== value) node.textContent = value;
}

function open(name) {
  stream?.close();
  view = name;
  shown?.close();
  shown = new Sections();
  shown.layOver([...runs.laidOver].filter((one) => one !== name));
  tuning.show(name);
  beat = { at: performance.now(), ages: {} };
  stream = new EventSource(`api/events?view=${encodeURIComponent(name)}`);
  stream.addEventListener("hello", (event) => {
    shown.clear(); // a new connection sends everything again
    ({ kind, commands: allowed } = JSON.parse(event.data));
    if (!key) allowed = [];
    showCommands();
  });
  stream.addEventListener("beat", (event) => {
    beat = { at: performance.now(), ages: JSON.parse(event.data) };
    showState();
  });
  stream.onmessage = (event) => {
    shown.take(JSON.parse(event.data));
    requestAnimationFrame(() => { shown.draw(); showState(); tuning.follow(shown.values); });
  };
  text($("title"), name);
  document.title = `${name} - estune`;
}

// The state in a word, its reason, and whether the data are up to date.
function judge(values) {
  const { rig, daemon, state } = values;
  const ofRun = kind === "run" && state;
  const silent_s = (performance.now() - beat.at) / 1000;
  const ages = Object.fromEntries(Object.entries(beat.ages).map(([k, s]) => [k, s + silent_s]));
  if (stream.readyState !== EventSource.OPEN || silent_s > STALE_S)
    return { word: "page disconnected", stale: true, age: silent_s,
      reason: "The page's server does not answer; what is shown is out of date." };
  for (const source of ["daemon", "rig", "run"]) {
    const fault = values[`fault.${source}`];
    const silent = source !== "run" && ages[source] > STALE_S;
    if (!fault && !silent) continue;
    if (source === "rig" && ofRun && state.status !== "running") continue; // the journal is enough
    if (source === "run" && kind !== "run") continue;
    return { word: `no link to the ${source}`, stale: true, age: ages[source],
      reason: fault || `The ${source} has not answered for ${ages[source].toFixed(1)} s.` };
  }
  const age = Math.max(0, ...Object.values(ages));
  if (rig?.latched) return { word: "emergency stop", bad: true, age, reason: rig.latched };
  if (daemon)
    return { word: daemon.mode, age, bad: Boolean(daemon.trouble),
      good: daemon.live && !daemon.paused, reason: daemon.trouble || daemon.paused || daemon.sentence };
  if (ofRun && state.status !== "running") {
    const [word, reason = ""] = state.status.split(/:(.*)/s);
    return { word, ended: true, bad: word === "failed" || word === "interrupted", reason: reason.trim() };
  }
  if (state?.status === "running") // between fast trials the rig's own mode would flicker
    return { word: rig?.mode === "aborting" ? "aborting" : "running", good: true, age,
      reason: state.phase && `phase: ${state.phase}` };
  if (rig) return { word: rig.mode, age, good: rig.mode === "running", reason: rig.sentence };
  return { word: "connecting", age, reason: "" };
}

function showState() {
  if (!shown) return;
  const values = shown.values, now = judge(values);
  const chip = $("state");
  text(chip, now.word);
  chip.className = `chip ${now.stale ? "stale" : now.bad ? "no" : now.good ? "yes" : ""}`;
  text($("reason"), now.reason ?? "");
  const age = now.ended ? "" : now.age === undefined || Number.isNaN(now.age) ? "no data yet"
    : now.age < STALE_S ? "up to date" : `data ${duration(now.age)} old`;
  text($("age"), age);
  $("age").className = `age ${now.stale ? "stale" : ""}`;
  document.querySelector("header").classList.toggle("stale-data", Boolean(now.stale));
  $("estop").hidden = !allowed.includes("estop") || Boolean(now.ended);
  const reset = document.querySelector('button[data-command="reset"]');
  if (reset) reset.hidden = !values.rig?.latched;
  const stop = document.querySelector('button[data-command="stop"]');
  if (stop && kind === "rig") stop.disabled = !values.rig?.holder && values.state?.status !== "running";
  showFacts(values);
  confirm(values);
}

export function duration(seconds) {
  if (seconds < 90) return `${Math.round(seconds)} s`;
  if (seconds < 5400) return `${Math.round(seconds / 60)} min`;
  return `${(seconds / 3600).toFixed(1)} h`;
}

function showFacts({ rig, description, daemon, state, run, elsewhere }) {
  const gains = (g) => g?.map((x) => Number(x.toPrecision(4))).join(", ");
  const facts = [];
  if (rig) facts.push(["held by", rig.holder || "nobody"]);
  const live = daemon ? daemon.gains[daemon.live] : description?.gains;
  if (live) facts.push([`live gains${daemon?.live ? ` (${daemon.live})` : ""}: P, I, D, filter`, gains(live)]);
  if (daemon && !daemon.live) facts.push(["live gains", "not confirmed by the rig"]);
  if (daemon?.margins) facts.push(["margins in service", daemon.margins]);
  if (daemon?.run) facts.push(["run", `${daemon.run}, ${daemon.trials} of ${daemon.trials_max}`]);
  if (state) {
    if (kind === "rig" && run) facts.push(["run", `${run.name}, ${state.status.split(":")[0]}`]);
    facts.push(["trials", state.status === "running" ? `${state.done} done, about ${state.left} left` : `${state.status === "finished" ? "all " : ""}${state.done} done`]);
    if (state.status === "running" && state.trial_s && state.left) facts.push(["time left", `about ${duration(state.trial_s * state.left)}`]);
    facts.push(["unsafe trials", String(state.unsafe)]);
    if (state.best) facts.push(["best cost", `${state.best.cost.toPrecision(4)} in trial ${state.best.number}`]);
  }
  if (elsewhere && rig?.holder) facts.push(["run", `${elsewhere}; its journal is not in this folder, so cost and search are not shown`]);
  if (run && !rig) facts.push(["rig", run.rig]);
  const list = $("facts"), content = JSON.stringify(facts);
  if (list.dataset.shown === content) return;
  list.dataset.shown = content;
  list.replaceChildren(...facts.map(([name, value]) => make("div", {}, make("dt", { textContent: name }), make("dd", { textContent: value }))));
}

// What the rig must show before a command counts as done.
const applied = (daemon, gains) => daemon.home === gains && daemon.live === gains
  && !["readying", "waiting", "retrying"].includes(daemon.mode);
const DONE = {
  estop: ({ rig }) => rig?.latched && "the rig confirms: it is in its safe state",
  accept: ({ daemon }) => !daemon.found && applied(daemon, "accepted") && "the rig confirms: the accepted gains are live",
  reject: ({ daemon }) => !daemon.found && daemon.live && `the rig confirms: the ${daemon.live} gains are live`,
  revert: ({ daemon }) => applied(daemon, "original") && "the rig confirms: the original gains are live",
  pause: ({ daemon }) => daemon.paused && daemon.live && `paused; the rig confirms its ${daemon.live} gains`,
  resume: ({ daemon }) => !daemon.paused && "supervision has resumed",
  stop: ({ daemon }) => daemon.mode === "stopped" && "the supervision has ended",
};
let pending = null;

async function command(name, given) {
  pending = null;
  text($("answer"), `${name}: sent, not confirmed yet`);
  let answer;
  try {
    const reply = await fetch("api/command", {
      method: "POST",
      headers: { Authorization: `Bearer ${key}`, "Content-Type": "application/json" },
      body: JSON.stringify({ view, command: name, arguments: given }),
    });
    answer = await reply.json();
  } catch {
    answer = { done: false, sentence: "the page's server does not answer" };
    if (name === "estop") answer.sentence += ": the rig must be taken as not stopped; cut its power";
  }
  if (!answer.done) text($("answer"), `${name}: not done: ${answer.sentence}`);
  else if (kind === "daemon" || name === "estop") {
    text($("answer"), `${name}: ${answer.sentence}; waiting for the rig to confirm`);
    pending = name;
  } else text($("answer"), `${name}: ${answer.sentence}`); // the server has asked the rig
  if (answer.done && ["label", "delete"].includes(name)) list();
}

function confirm(values) {
  const sentence = pending && DONE[pending](values);
  if (!sentence) return;
  text($("answer"), `${pending}: done; ${sentence}`);
  pending = null;
}

function showCommands() {
  $("commands").hidden = !allowed.length;
  const label = (name) => (kind === "daemon" ? name[0].toUpperCase() + name.slice(1) : BUTTONS[name]);
  const shownHere = allowed.filter((name) => name !== "estop" && (name !== "resume" || kind !== "rig") && label(name));
  document.querySelector("#commands .buttons").replaceChildren(...shownHere.map((name) => {
    const button = document.createElement("button");
    button.textContent = label(name);
    button.dataset.command = name;
    button.addEventListener("click", () => {
      if (name === "delete") {
        if (window.confirm(`Delete run ${view} with all of its trials? This cannot be undone.`)) command(name, { confirmed: view });
      } else if (kind !== "daemon" && name === "tune") openForm((settings) => command("tune", { settings }));
      else command(name, name === "resume" && kind === "run" ? { run: view } : undefined);
    });
    return button;
  }));
  tuning.act = kind !== "daemon" && allowed.includes("try") ? command : null;
}
const BUTTONS = { tune: "Start a tuning\u2026", stop: "Stop the tuning", resume: "Resume this run", reset: "Reset the emergency stop", delete: "Delete this run\u2026" };
$("estop").addEventListener("click", () => command("estop"));

let answer = { views: [] }, tag = ""; // the list, and what it is known by
async function list() {
  const silent_s = (performance.now() - beat.at) / 1000;
  try {
    const reply = await fetch("api/views", { headers: { "If-None-Match": tag } });
    if (reply.status !== 304) [answer, tag] = [await reply.json(), reply.headers.get("ETag")];
  } catch {
    return; // the state says that the server does not answer
  }
  const names = answer.views.map((one) => one.name);
  runs.show(answer.views, view);
  if (stream && (stream.readyState === EventSource.CLOSED || silent_s > AGAIN_S)) open(view);
  labels.show(answer.views.find((one) => one.name === view), allowed);
  const wanted = new URLSearchParams(location.search).get("view");
  if (!view && names.length) {
    open(names.includes(wanted) ? wanted : names[0]);
    list();
  } else if (!names.length) {
    text($("reason"), answer.fault || "There is no run in this folder yet.");
  }
}

list();
setInterval(list, 3000);
setInterval(showState, 250);
