// The list of rigs and runs: sorted by a column, filtered by words.

import { make } from "./charts.js";

const $ = (id) => document.getElementById(id);
const cost = (x) => (x == null ? "" : Number(x.toPrecision(4)).toString());
const time = (s) => (s == null ? "" : s < 1 ? `${cost(1e3 * s)} ms` : `${cost(s)} s`);
export const LAID_OVER_MAX = 5;
const DRAWN_MAX = 100; // rows until all are asked for: a table of 1000 takes a browser half a second
const texts = new WeakMap(), { compare } = new Intl.Collator();
const COLUMNS = [
  ["name", "name", (x) => x], ["state", "state", (x, { ending }) => ending ?? x], ["kind", "kind", (x) => x], ["rig", "rig", (x) => x ?? ""],
  ["begun", "begun", (x) => (x ? new Date(x).toLocaleString() : "")], ["trials", "trials", (x) => x ?? ""],
  ["rise_time_s", "rise", time],
  ["overshoot", "overshoot", (x) => (x == null ? "" : `${(100 * x).toFixed(1)} %`)], ["Ms", "Ms", (x, { Ms_interval: ends }) => (x == null ? "" : `${x.toFixed(2)}${ends ? ` (${ends.map((end) => end?.toFixed(2) ?? "\u221e").join(" to ")})` : ""}`)],
  ["start_cost", "cost before", cost], ["cost", "best cost", cost], ["tags", "tags", (x) => (x ?? []).join(", ")], ["note", "note", (x) => x ?? ""],
];

export class RunTable {
  constructor() {
    this.rows = [];
    this.by = "begun";
    this.falling = true;
    this.laidOver = new Set();
    this.drawn = new Map(); // rows of the table, each with what it shows
    $("all-views").addEventListener("click", () => {
      this.isWhole = true;
      this.draw();
      $("views").querySelector("tbody").rows[DRAWN_MAX]?.querySelector("a").focus();
    });
    $("filter").addEventListener("input", () => this.draw());
    $("views").querySelector("thead tr").replaceChildren(...COLUMNS.map(([key, label]) => {
      const button = make("button", { type: "button", textContent: label });
      button.addEventListener("click", () => {
        this.falling = this.by === key ? !this.falling : key === "begun";
        this.by = key;
        this.draw();
      });
      return make("th", { scope: "col" }, button);
    }), make("th", { scope: "col", textContent: "lay over" }));
  }

  // New rows, of which one is shown on the page; a rig stands above its runs.
  show(all, current) {
    if (all === this.all && current === this.current) return;
    const own = all.find(({ name, kind }) => name === current && kind !== "run");
    const alone = own?.kind === "rig" && all.filter(({ kind }) => kind !== "run").length < 2;
    const rows = alone ? all.filter(({ kind, rig }) => kind === "run" && rig === own.rig) : all;
    Object.assign(this, { all, current, rows });
    $("views").hidden = alone ? !rows.length : all.length < 2;
    $("views").querySelector("h2").textContent = alone ? "Runs of this rig" : "Rigs and runs";
    this.draw();
  }

  draw() {
    const words = $("filter").value.toLowerCase().split(/\s+/).filter(Boolean), sign = this.falling ? -1 : 1;
    const text = (row) => {
      if (!texts.has(row)) texts.set(row, COLUMNS.map(([key, , shown]) => shown(row[key], row)).join(" ").toLowerCase());
      return texts.get(row);
    };
    const order = (p, q) => { // rigs and daemons come first, rows without a value last
      if ((p.kind === "run") !== (q.kind === "run")) return p.kind === "run" ? 1 : -1;
      const [a, b] = [p[this.by] ?? "", q[this.by] ?? ""];
      if (a === "" || b === "") return (a === "") - (b === "");
      return sign * (typeof a === "number" ? a - b : compare(a, b));
    };
    const shown = this.rows.filter((row) => words.every((word) => text(row).includes(word))).sort(order);
    $("views").querySelectorAll("th:has(button)").forEach((th, n) => th.setAttribute("aria-sort", COLUMNS[n][0] !== this.by ? "none" : this.falling ? "descending" : "ascending"));
    const part = this.isWhole ? shown : shown.slice(0, DRAWN_MAX);
    $("all-views").hidden = part.length === shown.length;
    $("all-views").textContent = `Show all ${shown.length}`;
    this.drawn = new Map(part.map((row) => [row.name, this.filled(this.drawn.get(row.name) ?? this.made(row.name), row)]));
    place($("views").querySelector("tbody"), [...this.drawn.values()].map(({ tr }) => tr));
    const told = ["kind", "rig"], empty = COLUMNS.map(([key]) => this.rows.every((row) => row[key] == null || row[key].length === 0 || (told.includes(key) && row[key] === this.rows[0][key])));
    for (const { cells } of $("views").querySelectorAll("tr"))
      empty.forEach((none, n) => { if (cells[n].hidden !== none) cells[n].hidden = none; });
  }

  // A row of the table that shows nothing yet.
  made(name) {
    const tr = document.createElement("tr"), cells = COLUMNS.map(([key]) => Object.assign(tr.insertCell(), { className: key === "Ms" ? "whole" : "" }));
    const link = make("a", { href: `?view=${encodeURIComponent(name)}`, textContent: name });
    cells[0].append(link);
    const box = make("input", { type: "checkbox" });
    box.setAttribute("aria-label", `Lay ${name} over the shown run`);
    box.addEventListener("change", () => {
      this.laidOver[box.checked ? "add" : "delete"](name);
      this.draw();
      this.onLaidOver([...this.laidOver]);
    });
    tr.insertCell().append(box);
    return { tr, cells, link, box, content: "" };
  }

  // The row with what it is to show, in the elements that it has.
  filled(drawn, row) {
    const shown = row.name === this.current, laid = this.laidOver.has(row.name), full = this.laidOver.size >= LAID_OVER_MAX;
    const content = JSON.stringify([row, shown, laid, full]);
    if (drawn.content === content) return drawn;
    const { tr, cells, link, box } = drawn;
    tr.className = row.stale ? "stale" : "";
    COLUMNS.forEach(([key, , form], n) => { if (n) cells[n].textContent = form(row[key], row); });
    if (shown) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
    box.checked = laid;
    box.disabled = shown || (!laid && full);
    return Object.assign(drawn, { content });
  }
}

// Puts rows into a table in this order. A row in its place is not taken out: it would lose the focus.
function place(body, rows) {
  const wanted = new Set(rows), focused = document.activeElement;
  for (const row of [...body.rows]) if (!wanted.has(row)) row.remove();
  let next = body.firstElementChild;
  for (const row of rows) {
    if (row === next) next = next.nextElementSibling;
    else body.insertBefore(row, next);
  }
  if (focused !== document.activeElement && body.contains(focused)) focused.focus();
}
