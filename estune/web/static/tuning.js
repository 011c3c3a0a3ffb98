// The tuning page of a view: fetched when it is opened, and again after further trials.

const AGAIN_MS = 3000; // least time between two readings of a run that goes on
const $ = (id) => document.getElementById(id);

export class TuningSection {
  constructor() {
    this.tuner = null;
    this.act = null; // sends a command, where the page may
    $("tuning").addEventListener("toggle", () => this.load());
    if (new URLSearchParams(location.search).has("tune")) $("tuning").open = true;
  }

  // Shows another view.
  show(view) {
    this.view = view;
    this.done = undefined;
    this.tuner?.close();
    this.tuner = null;
    $("tuning").hidden = false;
    this.load();
  }

  // Follows the trials and the live gains of the view.
  follow({ state, description }) {
    this.live = description && Object.fromEntries(["P", "I", "D", "setpoint_filter_s"].map((name, n) => [name, description.gains[n]]));
    if (this.live) this.tuner?.setLive(this.live);
    if (state && state.done !== this.done) {
      this.done = state.done;
      clearTimeout(this.timer);
      this.timer = setTimeout(() => this.load(), AGAIN_MS);
    }
  }

  async load() {
    if (!$("tuning").open || !this.view) return;
    const view = this.view;
    let text;
    try {
      text = await (await fetch(`api/tuning?view=${encodeURIComponent(view)}`)).text();
    } catch {
      return; // the state says that the server does not answer
    }
    const { Tuner } = await import("./tuner.js");
    if (view !== this.view || (this.tuner && text === this.text)) return;
    const answer = JSON.parse(text);
    this.text = text;
    $("tuning-text").textContent = answer.reason;
    if (!answer.data || (this.tuner && this.tuner.touched)) return; // nobody's sliders are taken away
    this.tuner?.close();
    this.tuner = new Tuner($("tuner"), answer.data, this.live, this.act);
    $("tuner").tuner = this.tuner;
  }
}
