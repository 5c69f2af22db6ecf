// Completions of the word that is being typed: a list below the box, for keys and pointer.
import { byId, el } from "./dom.js";

const TYPING_DELAY = 120; // ms after the last letter

export class Completions {
  // suggestWords(text): a promise of {words: [{word, typed}]}.
  constructor(suggestWords) {
    Object.assign(this, { suggestWords, index: -1, requestNumber: 0 });
    this.box = byId("words");
    this.list = byId("completions");
    this.box.addEventListener("input", () => { clearTimeout(this.timer); this.timer = setTimeout(() => this.suggest(), TYPING_DELAY); });
    this.box.addEventListener("keydown", event => this.pressKey(event));
    this.box.addEventListener("blur", () => setTimeout(() => this.close(), 150)); // a click on the list is handled first
  }

  get lastWord() {
    return this.box.value.split(",").at(-1).trim();
  }

  async suggest() {
    const request = ++this.requestNumber;
    const { lastWord: typed } = this;
    if (!typed) return this.close();
    try {
      const { words } = await this.suggestWords(typed);
      if (request !== this.requestNumber || document.activeElement !== this.box) return;
      const isComplete = words.length === 1 && words[0].word.toLowerCase() === typed.toLowerCase();
      this.show(isComplete ? [] : words);
    } catch { this.close(); /* the text can be submitted without completions */ }
  }

  show(words) {
    this.index = -1;
    this.list.hidden = !words.length;
    this.box.setAttribute("aria-expanded", String(Boolean(words.length)));
    this.list.replaceChildren(...words.map(({ word, typed }, index) => el("li", { id: `completion-${index}`, role: "option", "aria-selected": "false", data: { word }, on: { pointerdown: event => { event.preventDefault(); this.choose(word, true); } } },
      word, typed === word ? null : el("small", {}, ` ${typed}`))));
    this.markOption();
  }

  markOption() {
    [...this.list.children].forEach((item, index) => item.setAttribute("aria-selected", String(index === this.index)));
    if (this.index < 0) this.box.removeAttribute("aria-activedescendant");
    else this.box.setAttribute("aria-activedescendant", `completion-${this.index}`);
  }

  pressKey(event) {
    const count = this.list.hidden ? 0 : this.list.children.length;
    if (!count) return;
    if (event.key === "ArrowDown" || event.key === "ArrowUp") {
      const step = event.key === "ArrowDown" ? 1 : -1;
      this.index = this.index < 0 && step < 0 ? count - 1 : (this.index + step + count) % count;
      this.markOption();
    } else if (event.key === "Enter" && this.index >= 0) this.choose(this.list.children[this.index].dataset.word, true);
    else if (event.key === "Escape") this.close();
    else return;
    event.preventDefault();
    event.stopPropagation();
  }

  choose(word, submit) {
    this.box.value = [...this.box.value.split(",").slice(0, -1).map(word => word.trim()), word].join(", ");
    this.close();
    if (submit) this.box.form.requestSubmit();
  }

  close() {
    this.requestNumber += 1;
    clearTimeout(this.timer);
    this.show([]);
  }
}
