// The panel of naming: many words at once, every splat in the colour of its best one; and what a clicked thing is.
import { at, count, el, fill, percent, plural, notify } from "./dom.js";
import { bytes, json, npy, post, words } from "./service.js";

const OWN = "own"; // the words of the form
const COVER = 0.78; // of a word's colour over the splats' own
const REST = [38, 42, 50]; // splats of no word, or of words that are not looked at
const SHOWN = 14; // words with a label at their place
const COLOURS = 216; // that differ
const PAGE = 100; // tables to choose from

export class Names {
  // changed: when colours, labels or the link must follow; centres: with a value a splat, the middle of each value's.
  // more: with an example to ask by; alone: when something is named, and no question is asked any more.
  constructor({ changed, centres, more, alone }) {
    Object.assign(this, { changed, centres, more, alone, lift: null, shown: false, only: new Set(), turn: 0 });
    at("naming").addEventListener("submit", event => { event.preventDefault(); this.fromForm(); });
    at("vocabulary").addEventListener("change", () => {
      this.chosen = at("vocabulary").value;
      at("own-words-label").hidden = this.chosen !== OWN;
    });
    at("unname").addEventListener("click", () => (this.shown ? this.rest() : this.bring()));
    at("what-more").addEventListener("click", () => this.more(this.spot.example));
  }

  async of(lift) {
    Object.assign(this, { lift, asked: null, found: null, values: null, shown: false, spot: null, chosen: null });
    this.only.clear();
    this.turn += 1;
    at("own-words").value = "";
    this.show();
    this.choose([]);
    await this.tables();
  }

  // Also those that were brought after the lift was opened.
  async tables() {
    const { lift } = this;
    if (!lift) return;
    const { assets } = await json(`/assets?limit=${PAGE}`);
    if (lift === this.lift) this.choose(assets.filter(({ kind }) => kind === "table"));
  }

  choose(tables) {
    const { lift } = this;
    const own = !lift || lift.text_space === "none" ? [] : [["", lift.words.length ? `The lift's own ${count(lift.words.length)} words` : "All words that the service knows"]];
    const vocabularies = [...own, ...tables.map(({ id }, place) => [id, `The words of table ${place + 1}`]), [OWN, "Words that you type"]];
    fill(at("vocabulary"), vocabularies, this.chosen ?? at("vocabulary").value); // a link may name a table before they are listed
    at("own-words-label").hidden = at("vocabulary").value !== OWN;
  }

  // What the service is asked: words of one's own, or all of a table.
  body() {
    const chosen = at("vocabulary").value;
    if (chosen !== OWN) return chosen ? { table: chosen } : {};
    return { words: [...new Set(at("own-words").value.split(/[,\n]/).map(word => word.trim()).filter(Boolean))] };
  }

  fromForm() {
    const asked = this.body();
    if (asked.words && !asked.words.length) {
      at("own-words").focus();
      return notify("Type some words first, with commas between.");
    }
    return this.name(asked);
  }

  async name(asked, only = []) {
    const mine = ++this.turn;
    at("named").textContent = "Naming every splat\u2026";
    at("stage").classList.add("asking");
    try {
      const [found, values] = await namedSplats(this.lift, asked);
      if (mine !== this.turn) return;
      Object.assign(this, { asked, found, values, none: found.none });
      this.only = new Set(found.named_words.filter(({ word }) => only.includes(word)).map(({ value }) => value));
      this.middles = this.centres(values, found.named_words.length);
      this.bring();
    } catch (problem) {
      if (mine !== this.turn) return;
      at("named").textContent = "";
      notify(problem.argument === "words" && !asked.words ? "Its text encoder takes any word, so there is no list of them: type the words that may be here." : words(problem), true);
      if (problem.argument === "words" && !asked.words) this.typing();
    } finally {
      if (mine === this.turn) at("stage").classList.remove("asking");
    }
  }

  typing() {
    at("vocabulary").value = this.chosen = OWN;
    at("own-words-label").hidden = false;
    at("own-words").focus();
  }

  // Colours of words in place of a question's.
  bring() {
    this.shown = Boolean(this.found);
    this.paint();
    if (this.shown) this.alone();
    this.show();
    this.changed();
  }

  rest() {
    if (!this.shown) return;
    this.shown = false;
    this.show();
    this.changed();
  }

  // A word alone, and with others after it; a second press takes it back.
  press(value) {
    if (!this.only.delete(value)) this.only.add(value);
    this.bring();
  }

  is(value) {
    return value > 0 && (!this.only.size || this.only.has(value));
  }

  paint() {
    if (!this.found) return;
    this.layer = inColours(this.found, this.values, value => this.is(value));
  }

  painted() {
    return this.shown ? this.layer : null;
  }

  // The words that are shown, with their colours.
  entries() {
    return this.shown ? this.found.named_words.filter(({ value }) => this.is(value)).map(({ word, colour }) => [word, hex(colour)]) : [];
  }

  // Where words stand, for their labels: points, which are boxes without a size.
  boxes() {
    const spot = this.spot?.point && this.spot.words.length && !at("panel-name").hidden
      ? [{ low: this.spot.point, high: this.spot.point, colour: "#ffffff", name: this.spot.words[0].word, of: 1, strong: true }] : [];
    if (!this.shown) return spot;
    const named = this.found.named_words.filter(({ value }) => this.is(value) && this.middles[value]).slice(0, SHOWN);
    return [...spot, ...named.map(({ value, word, colour }) => ({ low: this.middles[value], high: this.middles[value], colour: hex(colour), name: word, of: 1, strong: this.only.has(value), named: value }))];
  }

  // The map of a view, and how its colours are shown over the view; null where there is none to show.
  map(view) {
    if (!this.shown || this.found.named_words.length > COLOURS) return null; // of more words some share a colour
    const known = new Map(this.found.named_words.map(({ value, colour }) => [colour.join(), value]));
    const paint = ({ data, width, height }) => {
      const out = new Uint8ClampedArray(data.length);
      for (let place = 0; place < data.length; place += 4) {
        const colour = [data[place], data[place + 1], data[place + 2]];
        out.set(this.is(known.get(colour.join()) ?? 0) ? [...colour, 175] : [8, 10, 14, 190], place);
      }
      return new ImageData(out, width, height);
    };
    return { path: "/query/segment/map", body: { lift: this.lift.id, ...this.asked, view }, paint };
  }

  // What is this? point: where it was clicked in 3D.
  async what(example, point = null) {
    const { lift } = this;
    this.spot = { example, point, words: [] };
    this.show();
    const asked = this.shown ? this.asked : this.body();
    const vocabulary = asked.words && !asked.words.length ? {} : asked;
    try {
      const answer = await post("/query/what", { lift: lift.id, example, ...vocabulary });
      if (this.spot?.example !== example) return;
      this.spot.words = answer.words;
    } catch (problem) {
      this.spot = null;
      notify(words(problem), true);
      if (problem.argument === "words") this.typing();
    }
    this.show();
    this.changed();
  }

  restore(parameters) {
    const named = parameters.getAll("named");
    const table = parameters.get("table");
    if (!named.length) return;
    const own = named[0] !== "*";
    if (own) at("own-words").value = named.join(", ");
    at("vocabulary").value = this.chosen = own ? OWN : table ?? "";
    at("own-words-label").hidden = !own;
    this.name(linkedWords(parameters), parameters.getAll("only"));
  }

  link(parameters) {
    if (!this.shown) return;
    for (const word of this.asked.words ?? ["*"]) parameters.append("named", word);
    if (this.asked.table) parameters.set("table", this.asked.table);
    for (const { value, word } of this.found.named_words) if (this.only.has(value)) parameters.append("only", word);
  }

  show() {
    const { found, spot } = this;
    at("unname").hidden = !found;
    at("unname").textContent = this.shown ? "Show the scene's colours" : "Show the words again";
    at("named").textContent = found ? `${plural(found.named_words.length, "word")} of ${count(found.word_count)} ${found.named_words.length === 1 ? "is" : "are"} here; ${percent(found.none / found.splats)} of the splats have none.` : "";
    at("legend").replaceChildren(...(found ? [...found.named_words.map(named => line(named, this)), none(found)] : []));
    at("what").hidden = !spot;
    if (!spot) return;
    at("what-of").textContent = spot.words.length ? `Most like \u201c${spot.words[0].word}\u201d` : "Looking\u2026";
    at("what-words").replaceChildren(...spot.words.map(({ word, score }) => el("li", {}, el("span", {}, word), el("span", { className: "score" }, score.toFixed(3)))));
  }
}

// The words of a link, as the service is asked for them.
export function linkedWords(parameters) {
  const words = parameters.getAll("named");
  return words[0] !== "*" ? { words } : parameters.has("table") ? { table: parameters.get("table") } : {};
}

// Which words are here, and the number of each splat's.
export async function namedSplats(lift, asked) {
  const body = { lift: lift.id, ...asked };
  const found = await post("/query/segment", body);
  return [found, npy(await bytes("/query/segment/labels", { body }))];
}

// The layer of such splats; words that are not looked at have the colour of none.
export function inColours(found, values, looked) {
  const palette = [REST, ...found.named_words.map(({ value, colour }) => (looked(value) ? colour : REST))];
  const colours = new Uint8Array(3 * values.length);
  values.forEach((value, row) => colours.set(palette[value], 3 * row));
  return { colours, cover: COVER };
}

const line = (named, names) => el("li", {}, el("button", { type: "button", className: "thing", style: { "--mine": hex(named.colour) }, "aria-pressed": String(names.only.has(named.value)), on: { click: () => names.press(named.value) } },
  el("span", { className: "swatch", "aria-hidden": "true" }), el("span", {}, named.word), el("span", { className: "score" }, count(named.splats))));
const none = found => el("li", {}, el("span", { className: "thing rest", style: { "--mine": hex(REST) } },
  el("span", { className: "swatch", "aria-hidden": "true" }), el("span", {}, "none"), el("span", { className: "score" }, count(found.none))));
const hex = colour => `#${colour.map(value => value.toString(16).padStart(2, "0")).join("")}`;
