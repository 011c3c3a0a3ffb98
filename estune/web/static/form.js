// A form for the settings of a tuning, made from their declaration; what is left empty is the rig's.

import { make } from "./charts.js";

function field({ name, type, choices, unit, help, otherwise }) {
  const id = `setting-${name}`;
  const input = choices.length
    ? make("select", { id, name }, new Option(`${otherwise} (default)`, ""), ...choices.map((one) => new Option(one, one)))
    : make("input", { id, name, placeholder: otherwise, inputMode: type === "str" ? "text" : "decimal", autocomplete: "off" });
  input.setAttribute("aria-describedby", `${id}-help`);
  const words = name.replace(/_(N|s|deg)$/, "").replaceAll("_", " ");
  return make("div", { className: "field" }, make("label", { htmlFor: id }, unit && unit !== "N" ? `${words}, ${unit}` : words), input,
    make("small", { id: `${id}-help`, className: "soft", textContent: help }));
}

// Opens the form; `start` is called with the settings that were given.
export async function openForm(start) {
  const dialog = document.getElementById("form");
  const groups = await (await fetch("api/form")).json();
  const fieldset = ({ title, settings }, n) => make("details", { open: n < 2 }, make("summary", {}, title), ...settings.map(field));
  const form = make("form", { method: "dialog" }, make("h2", { id: "form-title", textContent: "Start a tuning" }),
    make("p", { className: "soft", textContent: "The rig will move. Each trial uses temporary gains; the rig then restores its live ones." }),
    ...groups.map(fieldset),
    make("div", { className: "buttons" }, make("button", { value: "start", textContent: "Start" }), make("button", { value: "", textContent: "Cancel", formNoValidate: true })));
  dialog.replaceChildren(form);
  dialog.onclose = () => {
    if (dialog.returnValue !== "start") return;
    const given = [...new FormData(form)].filter(([, value]) => value.trim());
    start(Object.fromEntries(given));
  };
  dialog.returnValue = "";
  dialog.showModal();
}
