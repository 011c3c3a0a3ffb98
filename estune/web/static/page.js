// The page: follows one view by server-sent events.

import { confirmGains, openForm } from "./form.js";
import { LabelForm } from "./labels.js";
import { RunTable } from "./runs.js";
import { Sections } from "./sections.js";
import { TuningSection } from "./tuning.js";

const STALE_S = 1.5; // the rig is read four times a second
const SPOKEN_MS = 15000;
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
  stream.addEventListener("hello", ({ data }) => {
    shown.clear(); // a new one sends all again
    ({ kind } = JSON.parse(data));
  });
  stream.addEventListener("commands", ({ data }) => {
    allowed = key ? JSON.parse(data) : [];
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

// The state as the server says it, unless the server does not answer.
function showState() {
  if (!shown) return;
  const v = shown.values, silent_s = (performance.now() - beat.at) / 1000;
  const lost = stream.readyState !== EventSource.OPEN || silent_s > STALE_S;
  const now = lost ? { word: "page disconnected", tone: "stale", sentence: "The page's server does not answer." }
    : v.banner ?? { word: "connecting", tone: "", sentence: "" };
  const age = lost ? silent_s : now.ended ? 0 : Math.max(0, ...Object.values(beat.ages)) + silent_s;
  text($("state"), now.word);
  $("state").className = `chip ${now.tone}`;
  for (const id of ["reason", "more"]) text($(id), now.sentence);
  $("more").className = ["no", "stale"].includes(now.tone) ? `lead ${now.tone}` : "";
  const { offsetWidth, scrollWidth } = $("reason"); // none on a telephone
  $("more").hidden = !$("more").className && offsetWidth > 0 && scrollWidth <= offsetWidth;
  text($("age"), age < STALE_S ? "" : `data ${duration(age)} old`);
  document.body.classList.toggle("stale-data", now.tone === "stale");
  const running = v.state?.status === "running", kept = (name) => document.querySelector(`button[data-command="${name}"]`) ?? {};
  $("estop").hidden = !allowed.includes("estop") || Boolean(now.ended);
  kept("reset").hidden = !v.rig?.latched;
  if (kind === "rig") {
    kept("stop").hidden = !running;
    kept("tune").hidden = running || !v.rig || v.rig.latched || now.word === "starting";
    kept("tune").className = $("offer").hidden ? "primary" : ""; // one button is the next step
  } else if (kind === "run") {
    kept("stop").hidden = !running;
    kept("resume").hidden = running || v.state?.status === "finished";
  }
  confirm(v);
}

const duration = (s) => (s < 90 ? `${Math.round(s)} s` : `${Math.round(s / 60)} min`);

// What a rig must show before a command is done.
const applied = (daemon, gains) => daemon.home === gains && daemon.live === gains
  && !["readying", "waiting", "retrying"].includes(daemon.mode);
const BY_RIG = "the rig confirms: ", DONE = {
  estop: ({ rig }) => rig?.latched && `${BY_RIG}it is in its safe state`,
  accept: ({ daemon }) => !daemon.found && applied(daemon, "accepted") && `${BY_RIG}the accepted gains are live`,
  reject: ({ daemon }) => !daemon.found && daemon.live && `${BY_RIG}the ${daemon.live} gains are live`,
  revert: ({ daemon }) => applied(daemon, "original") && `${BY_RIG}the original gains are live`,
  pause: ({ daemon }) => daemon.paused && daemon.live && `paused; ${BY_RIG}the ${daemon.live} gains are live`,
  resume: ({ daemon }) => !daemon.paused && "supervision has resumed",
  stop: ({ daemon }) => daemon.mode === "stopped" && "the supervision has ended",
};
let pending = null, spoken;

// Says for a while what came of a command.
function say(sentence) {
  text($("answer"), sentence);
  clearTimeout(spoken);
  if (!pending) spoken = setTimeout(() => text($("answer"), ""), SPOKEN_MS);
}

// Sends a command; its answer is said and returned.
async function command(name, given) {
  pending = null;
  say(`${name}: sent, not confirmed yet`);
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
  if (answer.done && (kind === "daemon" || name === "estop")) {
    pending = name;
    say(`${name}: ${answer.sentence}; waiting for the rig to confirm`);
  } else if (answer.done && ["tune", "resume"].includes(name)) say(""); // the state says so
  else say(`${name}: ${answer.done ? "" : "not done: "}${answer.sentence}`); // the server has asked the rig
  if (answer.done && ["label", "delete"].includes(name)) list();
  return answer;
}

function confirm(values) {
  const sentence = pending && DONE[pending](values);
  if (!sentence) return;
  const name = pending;
  pending = null;
  say(`${name}: done; ${sentence}`);
}

// Makes gains live once that is agreed.
async function apply({ gains, heads, rows, limits }) {
  const { description: about, "curve.tried": tried } = shown.values;
  if (!about) return say("apply: without a link to the rig nothing can be applied");
  const names = Object.keys(gains), instead_of = Object.fromEntries(names.map((name, n) => [name, about.gains[n]]));
  const number = (x) => Number(x.toPrecision(4)).toString();
  const measured = tried && names.every((name, n) => tried.gains[n] === gains[name]) ? `Measured in one trial: ${tried.measured}.` : "";
  const changed = names.map((name, n) => [about.gain_labels[n], number(instead_of[name]), number(gains[name]), about.gain_bounds[n]]);
  if (await confirmGains(changed, heads, rows, [measured, limits].filter(Boolean))) command("apply", { gains, instead_of });
}
$("offer").addEventListener("click", () => apply({ heads: ["initial gains", "tuned gains"], ...shown.values.result.offer }));

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
      } else if (name === "reset") {
        if (window.confirm("Reset the emergency stop? The rig may move again; make sure that the cause is removed.")) command(name);
      } else if (kind !== "daemon" && name === "tune") openForm(view, (settings) => command("tune", { settings }));
      else command(name, name === "resume" && kind === "run" ? { run: view } : undefined);
    });
    return button;
  }));
  tuning.act = kind !== "daemon" && allowed.includes("try") ? { try: (gains) => command("try", { gains }), apply } : null;
  shown.mayApply = allowed.includes("apply");
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
  const rigs = answer.views.filter((one) => one.kind !== "run").length, nav = $("views");
  const before = $(rigs === 1 ? "search" : "more"); // earlier runs stand below their rig
  if (nav.previousElementSibling !== before) before.after(nav);
  if (stream && (stream.readyState === EventSource.CLOSED || silent_s > AGAIN_S)) open(view);
  labels.show(answer.views.find((one) => one.name === view), allowed);
  const wanted = new URLSearchParams(location.search).get("view");
  if (!view && names.length) {
    open(names.includes(wanted) ? wanted : names[0]);
    list();
  } else if (!names.length) {
    text($("more"), answer.fault || "There is no run in this folder yet.");
  }
}

list();
setInterval(list, 3000);
setInterval(showState, 250);
