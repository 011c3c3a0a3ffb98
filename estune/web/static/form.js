// The form that starts a tuning, made by the server, and the question before gains are made live.

import { make } from "./charts.js";

const dialog = document.getElementById("form"), page = document.querySelector("main");
// Not modal: a modal dialog makes all else inert, the emergency stop, too.
function show() {
  page.inert = true;
  dialog.show();
}
dialog.addEventListener("close", () => { page.inert = false; });
document.addEventListener("keydown", ({ key }) => { if (key === "Escape" && dialog.open) dialog.close(""); });
const button = (textContent, properties) => make("button", { ...properties }, textContent);

function field({ name, label, choices, is_number, help, otherwise, is_open }) {
  const id = `setting-${name}`;
  const input = choices.length
    ? make("select", { id, name }, new Option(`${otherwise} (default)`, ""), ...choices.map((one) => new Option(one, one)))
    : make("input", { id, name, placeholder: otherwise, value: is_open ? otherwise : "", inputMode: is_number ? "decimal" : "text", autocomplete: "off" });
  input.setAttribute("aria-describedby", `${id}-help`);
  return make("div", { className: "field" }, make("label", { htmlFor: id }, label), input,
    make("small", { id: `${id}-help`, className: "soft", textContent: help }));
}

// Opens the form of a view; `start` sends the settings, and comes back with the answer.
export async function openForm(view, start) {
  const { open, more, expected } = await (await fetch(`api/form?view=${encodeURIComponent(view)}`)).json();
  const said = make("p", { className: "wrong" }), cancel = button("Cancel", { type: "button" });
  said.setAttribute("role", "alert");
  const form = make("form", {}, make("h2", { id: "form-title", textContent: "Start a tuning" }),
    make("p", {}, expected),
    make("p", { className: "soft" }, "The rig will move. After each trial it restores its live gains."),
    ...open.map(field),
    make("details", {}, make("summary", {}, "More"),
      ...more.map(({ title, settings }) => make("fieldset", {}, make("legend", {}, title), ...settings.map(field)))),
    said, make("div", { className: "buttons" }, button("Start", { className: "primary" }), cancel));
  cancel.addEventListener("click", () => dialog.close());
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    form.querySelectorAll(".wrong").forEach((one) => (one === said ? said.replaceChildren() : one.remove()));
    const { done, sentence, fields = {} } = await start(Object.fromEntries([...new FormData(form)].filter(([, value]) => value.trim())));
    if (done) return dialog.close();
    for (const [name, why] of Object.entries(fields)) {
      const input = form.elements[name];
      input.after(make("small", { className: "wrong" }, why));
      input.closest("details")?.setAttribute("open", "");
      input.focus();
    }
    if (!Object.keys(fields).length) said.textContent = sentence;
  });
  dialog.replaceChildren(form);
  show();
}

// Whether gains are to become live.
export function confirmGains(gains, heads, rows, notes) {
  const table = (head, lines) => make("table", {}, make("tr", {}, ...head.map((textContent) => make("th", { scope: "col" }, textContent))),
    ...lines.map(([name, ...cells]) => make("tr", {}, make("th", { scope: "row" }, name), ...cells.map((textContent) => make("td", {}, textContent)))));
  dialog.replaceChildren(make("form", { method: "dialog" }, make("h2", { id: "form-title", textContent: "Make these gains live on the rig?" }),
    table(["gain", "live now", "new", "bounds"], gains), table(["response", ...heads], rows), ...notes.map((textContent) => make("p", {}, textContent)),
    make("div", { className: "buttons" }, button("Make live", { value: "yes", className: "primary" }), button("Cancel", { value: "" }))));
  dialog.returnValue = "";
  show();
  return new Promise((resolve) => { dialog.onclose = () => resolve(dialog.returnValue === "yes"); });
}
