// The panel Label: every splat in the colour of its nearest word, and the words of a clicked object.
import { byId, formatCount, el, fillSelect, percent, plural, notify } from "./dom.js";
import { fetchBytes, fetchJson, readNpy, post, problemText } from "./service.js";

const TYPED_WORDS = "own"; // the vocabulary of typed words
const COVER = 0.78; // opacity of a word's colour over the splats' colours
const NEUTRAL = [38, 42, 50]; // colour of splats without a word, or with a word that is hidden
const MAX_LABELS = 14; // words with a label in the scene
const DISTINCT_COLOURS = 216; // number of distinct colours
const PAGE_SIZE = 100; // tables to choose from

export class LabelPanel {
  // onChange(): colours, labels or the link must be updated. centresOf(values, maxValue): the centre of the splats of each
  // value. findSimilar(example): query an example. onShow(): labels replace the questions.
  constructor({ onChange, centresOf, findSimilar, onShow }) {
    Object.assign(this, { onChange, centresOf, findSimilar, onShow, lift: null, isShown: false, selectedValues: new Set(), requestNumber: 0 });
    byId("naming").addEventListener("submit", event => { event.preventDefault(); this.fromForm(); });
    byId("vocabulary").addEventListener("change", () => {
      this.chosenVocabulary = byId("vocabulary").value;
      byId("own-words-label").hidden = this.chosenVocabulary !== TYPED_WORDS;
    });
    byId("unname").addEventListener("click", () => (this.isShown ? this.hideLabels() : this.showLabels()));
    byId("what-more").addEventListener("click", () => this.findSimilar(this.pickedPlace.example));
  }

  async setLift(lift) {
    Object.assign(this, { lift, vocabulary: null, segmentation: null, values: null, isShown: false, pickedPlace: null, chosenVocabulary: null });
    this.selectedValues.clear();
    this.requestNumber += 1;
    byId("own-words").value = "";
    this.render();
    this.fillVocabularies([]);
    await this.listTables();
  }

  // List the tables of words again, with those that were uploaded since the lift was opened.
  async listTables() {
    const { lift } = this;
    if (!lift) return;
    const { assets } = await fetchJson(`/assets?limit=${PAGE_SIZE}`);
    if (lift === this.lift) this.fillVocabularies(assets.filter(({ kind }) => kind === "table"));
  }

  fillVocabularies(tables) {
    const { lift } = this;
    const builtIn = !lift || lift.text_space === "none" ? [] : [["", lift.words.length ? `The ${formatCount(lift.words.length)} words of the lift` : "All words of the service"]];
    const vocabularies = [...builtIn, ...tables.map(({ id }, index) => [id, `Words of table ${index + 1}`]), [TYPED_WORDS, "Typed words"]];
    fillSelect(byId("vocabulary"), vocabularies, this.chosenVocabulary ?? byId("vocabulary").value); // a link may choose a table before tables are listed
    byId("own-words-label").hidden = byId("vocabulary").value !== TYPED_WORDS;
  }

  // The vocabulary of the form: typed words, a table, or {} for the default.
  vocabularyOfForm() {
    const selected = byId("vocabulary").value;
    if (selected !== TYPED_WORDS) return selected ? { table: selected } : {};
    return { words: [...new Set(byId("own-words").value.split(/[,\n]/).map(word => word.trim()).filter(Boolean))] };
  }

  fromForm() {
    const vocabulary = this.vocabularyOfForm();
    if (vocabulary.words && !vocabulary.words.length) {
      byId("own-words").focus();
      return notify("Type some words first, separated by commas.");
    }
    return this.labelSplats(vocabulary);
  }

  async labelSplats(vocabulary, only = []) {
    const request = ++this.requestNumber;
    byId("named").textContent = "Labelling the splats\u2026";
    byId("stage").classList.add("asking");
    try {
      const [segmentation, values] = await segmentSplats(this.lift, vocabulary);
      if (request !== this.requestNumber) return;
      Object.assign(this, { vocabulary, segmentation, values });
      this.selectedValues = new Set(segmentation.named_words.filter(({ word }) => only.includes(word)).map(({ value }) => value));
      this.centres = this.centresOf(values, segmentation.named_words.length);
      this.showLabels();
    } catch (problem) {
      if (request !== this.requestNumber) return;
      byId("named").textContent = "";
      notify(problem.argument === "words" && !vocabulary.words ? "This text encoder has an open vocabulary, so there is no list of words. Type the words to choose from." : problemText(problem), true);
      if (problem.argument === "words" && !vocabulary.words) this.openTypedWords();
    } finally {
      if (request === this.requestNumber) byId("stage").classList.remove("asking");
    }
  }

  openTypedWords() {
    byId("vocabulary").value = this.chosenVocabulary = TYPED_WORDS;
    byId("own-words-label").hidden = false;
    byId("own-words").focus();
  }

  // Show the colours of words instead of a question.
  showLabels() {
    this.isShown = Boolean(this.segmentation);
    this.updateLayer();
    if (this.isShown) this.onShow();
    this.render();
    this.onChange();
  }

  hideLabels() {
    if (!this.isShown) return;
    this.isShown = false;
    this.render();
    this.onChange();
  }

  // Show a word alone, or beside the words that are shown alone; a second click reverses it.
  toggleValue(value) {
    if (!this.selectedValues.delete(value)) this.selectedValues.add(value);
    this.showLabels();
  }

  isVisible(value) {
    return value > 0 && (!this.selectedValues.size || this.selectedValues.has(value));
  }

  updateLayer() {
    if (!this.segmentation) return;
    this.layer = wordLayer(this.segmentation, this.values, value => this.isVisible(value));
  }

  paintedLayer() {
    return this.isShown ? this.layer : null;
  }

  // The positions of labels, as boxes of size zero.
  boxes() {
    const pickedBox = this.pickedPlace?.point && this.pickedPlace.words.length && !byId("panel-name").hidden
      ? [{ low: this.pickedPlace.point, high: this.pickedPlace.point, colour: "#ffffff", name: this.pickedPlace.words[0].word, of: 1, strong: true }] : [];
    if (!this.isShown) return pickedBox;
    const labelled = this.segmentation.named_words.filter(({ value }) => this.isVisible(value) && this.centres[value]).slice(0, MAX_LABELS);
    return [...pickedBox, ...labelled.map(({ value, word, colour }) => ({ low: this.centres[value], high: this.centres[value], colour: hex(colour), name: word, of: 1, strong: this.selectedValues.has(value), labelValue: value }))];
  }

  // The request for the label map of a view and the function that colours it; null if no labels are shown.
  mapSource(view) {
    if (!this.isShown || this.segmentation.named_words.length > DISTINCT_COLOURS) return null; // more words would share colours
    const valueOf = new Map(this.segmentation.named_words.map(({ value, colour }) => [colour.join(), value]));
    const paint = ({ data, width, height }) => {
      const out = new Uint8ClampedArray(data.length);
      for (let offset = 0; offset < data.length; offset += 4) {
        const colour = [data[offset], data[offset + 1], data[offset + 2]];
        out.set(this.isVisible(valueOf.get(colour.join()) ?? 0) ? [...colour, 175] : [8, 10, 14, 190], offset);
      }
      return new ImageData(out, width, height);
    };
    return { path: "/query/segment/map", body: { lift: this.lift.id, ...this.vocabulary, view }, paint };
  }

  // Find the words of the object at an example. point: its position in 3D, for a label.
  async labelPlace(example, point = null) {
    const { lift } = this;
    this.pickedPlace = { example, point, words: [] };
    this.render();
    const source = this.isShown ? this.vocabulary : this.vocabularyOfForm();
    const vocabulary = source.words && !source.words.length ? {} : source;
    try {
      const answer = await post("/query/what", { lift: lift.id, example, ...vocabulary });
      if (this.pickedPlace?.example !== example) return;
      this.pickedPlace.words = answer.words;
    } catch (problem) {
      this.pickedPlace = null;
      notify(problemText(problem), true);
      if (problem.argument === "words") this.openTypedWords();
    }
    this.render();
    this.onChange();
  }

  restore(parameters) {
    const labels = parameters.getAll("named");
    const table = parameters.get("table");
    if (!labels.length) return;
    const isTyped = labels[0] !== "*";
    if (isTyped) byId("own-words").value = labels.join(", ");
    byId("vocabulary").value = this.chosenVocabulary = isTyped ? TYPED_WORDS : table ?? "";
    byId("own-words-label").hidden = !isTyped;
    this.labelSplats(linkedWords(parameters), parameters.getAll("only"));
  }

  link(parameters) {
    if (!this.isShown) return;
    for (const word of this.vocabulary.words ?? ["*"]) parameters.append("named", word);
    if (this.vocabulary.table) parameters.set("table", this.vocabulary.table);
    for (const { value, word } of this.segmentation.named_words) if (this.selectedValues.has(value)) parameters.append("only", word);
  }

  render() {
    const { segmentation, pickedPlace } = this;
    byId("unname").hidden = !segmentation;
    byId("unname").textContent = this.isShown ? "Show the scene's colours" : "Show the labels";
    byId("named").textContent = segmentation ? `${plural(segmentation.named_words.length, "word")} of ${formatCount(segmentation.word_count)} ${segmentation.named_words.length === 1 ? "labels" : "label"} splats; ${percent(segmentation.none / segmentation.splats)} of the splats have no label.` : "";
    byId("legend").replaceChildren(...(segmentation ? [...segmentation.named_words.map(entry => legendItem(entry, this)), unlabelledItem(segmentation)] : []));
    byId("what").hidden = !pickedPlace;
    if (!pickedPlace) return;
    byId("what-of").textContent = pickedPlace.words.length ? `Nearest word: \u201c${pickedPlace.words[0].word}\u201d` : "Searching\u2026";
    byId("what-words").replaceChildren(...pickedPlace.words.map(({ word, score }) => el("li", {}, el("span", {}, word), el("span", { className: "score" }, score.toFixed(3)))));
  }
}

// The vocabulary of a link, as the service takes it.
export function linkedWords(parameters) {
  const words = parameters.getAll("named");
  return words[0] !== "*" ? { words } : parameters.has("table") ? { table: parameters.get("table") } : {};
}

// The words that label splats, and the value of each splat: 0 for none, else that of its word.
export async function segmentSplats(lift, vocabulary) {
  const body = { lift: lift.id, ...vocabulary };
  const segmentation = await post("/query/segment", body);
  return [segmentation, readNpy(await fetchBytes("/query/segment/labels", { body }))];
}

// The layer of labelled splats; hidden words have the neutral colour.
export function wordLayer(segmentation, values, isVisible) {
  const palette = [NEUTRAL, ...segmentation.named_words.map(({ value, colour }) => (isVisible(value) ? colour : NEUTRAL))];
  const colours = new Uint8Array(3 * values.length);
  values.forEach((value, row) => colours.set(palette[value], 3 * row));
  return { colours, cover: COVER };
}

const legendItem = (entry, panel) => el("li", {}, el("button", { type: "button", className: "object", style: { "--mine": hex(entry.colour) }, "aria-pressed": String(panel.selectedValues.has(entry.value)), on: { click: () => panel.toggleValue(entry.value) } },
  el("span", { className: "swatch", "aria-hidden": "true" }), el("span", {}, entry.word), el("span", { className: "score" }, formatCount(entry.splats))));
const unlabelledItem = segmentation => el("li", {}, el("span", { className: "object rest", style: { "--mine": hex(NEUTRAL) } },
  el("span", { className: "swatch", "aria-hidden": "true" }), el("span", {}, "none"), el("span", { className: "score" }, formatCount(segmentation.none))));
const hex = colour => `#${colour.map(value => value.toString(16).padStart(2, "0")).join("")}`;
