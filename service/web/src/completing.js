// Completion of the word that is being typed, from what can be asked: a list below the box, by keys or by a press.
import { at, el } from "./dom.js";

const SOON = 120; // ms after the last letter

export class Completing {
  // askable: gives a promise of {words: [{word, typed}]} for a text.
  constructor(askable) {
    Object.assign(this, { askable, chosen: -1, turn: 0 });
    this.box = at("words");
    this.list = at("completions");
    this.box.addEventListener("input", () => { clearTimeout(this.soon); this.soon = setTimeout(() => this.look(), SOON); });
    this.box.addEventListener("keydown", event => this.key(event));
    this.box.addEventListener("blur", () => setTimeout(() => this.close(), 150)); // a press on the list comes first
  }

  get typed() {
    return this.box.value.split(",").at(-1).trim();
  }

  async look() {
    const mine = ++this.turn;
    const { typed } = this;
    if (!typed) return this.close();
    try {
      const { words } = await this.askable(typed);
      if (mine !== this.turn || document.activeElement !== this.box) return;
      const only = words.length === 1 && words[0].word.toLowerCase() === typed.toLowerCase();
      this.show(only ? [] : words);
    } catch { this.close(); /* it is asked all the same */ }
  }

  show(words) {
    this.chosen = -1;
    this.list.hidden = !words.length;
    this.box.setAttribute("aria-expanded", String(Boolean(words.length)));
    this.list.replaceChildren(...words.map(({ word, typed }, place) => el("li", { id: `completion-${place}`, role: "option", "aria-selected": "false", data: { word }, on: { pointerdown: event => { event.preventDefault(); this.take(word, true); } } },
      word, typed === word ? null : el("small", {}, ` ${typed}`))));
    this.mark();
  }

  mark() {
    [...this.list.children].forEach((line, place) => line.setAttribute("aria-selected", String(place === this.chosen)));
    if (this.chosen < 0) this.box.removeAttribute("aria-activedescendant");
    else this.box.setAttribute("aria-activedescendant", `completion-${this.chosen}`);
  }

  key(event) {
    const count = this.list.hidden ? 0 : this.list.children.length;
    if (!count) return;
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      const by = event.key === "ArrowDown" ? 1 : -1;
      this.chosen = this.chosen < 0 && by < 0 ? count - 1 : (this.chosen + by + count) % count;
      this.mark();
    } else if (event.key === "Enter" && this.chosen >= 0) this.take(this.list.children[this.chosen].dataset.word, true);
    else if (event.key === "Escape") this.close();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  take(word, asked) {
    this.box.value = [...this.box.value.split(",").slice(0, -1).map(one => one.trim()), word].join(", ");
    this.close();
    if (asked) this.box.form.requestSubmit();
  }

  close() {
    this.turn += 1;
    clearTimeout(this.soon);
    this.show([]);
  }
}
