// Tags and a note of the run on the page, where the page may change them.

export class LabelForm {
  constructor(store) {
    this.form = document.getElementById("labels");
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      const { tags, note } = this.form.elements;
      store({ tags: tags.value, note: note.value });
    });
  }

  // Shows the labels of a row of the list; what somebody is typing is left alone.
  show(row, allowed) {
    this.form.hidden = !row || !allowed.includes("label");
    if (this.form.hidden || this.form.contains(document.activeElement)) return;
    this.form.elements.tags.value = (row.tags ?? []).join(", ");
    this.form.elements.note.value = row.note ?? "";
  }
}
