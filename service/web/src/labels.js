// The panel Label: every splat in the colour of its nearest word.
import { byId, formatCount, el, percent, plural, notify } from "./dom.js";
import { fetchBytes, readNpy, post, problemText } from "./service.js";

const COVER = 0.78; // opacity of a word's colour over the splats' colours
const NEUTRAL = [38, 42, 50]; // colour of splats without a word, or with a word that is hidden
const MAX_LABELS = 14; // words with a label in the scene
const DISTINCT_COLOURS = 216; // words at most that a map tells by their colours

export class LabelPanel {
  // onChange(): colours, labels or the link must be updated. centresOf(values, maxValue): the centre of the splats of each
  // value. onShow(): labels replace the questions.
  constructor({ onChange, centresOf, onShow }) {
    Object.assign(this, { onChange, centresOf, onShow, lift: null, isShown: false, selectedValues: new Set(), requestNumber: 0 });
    byId("naming").addEventListener("submit", event => { event.preventDefault(); this.fromForm(); });
    byId("unname").addEventListener("click", () => (this.isShown ? this.hideLabels() : this.showLabels()));
  }

  setLift(lift) {
    Object.assign(this, { lift, vocabulary: null, segmentation: null, values: null, isShown: false });
    this.selectedValues.clear();
    this.requestNumber += 1;
    byId("own-words").value = "";
    this.render();
    byId("own-words").placeholder = lift?.words.length ? `The ${formatCount(lift.words.length)} words of the lift` : "All words of the service";
  }

  // Label by the words of the form, or by all words.
  fromForm() {
    const words = [...new Set(byId("own-words").value.split(/[,\n]/).map(word => word.trim()).filter(Boolean))];
    return this.labelSplats(words.length ? { words } : {});
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
      if (problem.argument === "words") byId("own-words").focus();
    } finally {
      if (request === this.requestNumber) byId("stage").classList.remove("asking");
    }
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
    if (!this.isShown) return [];
    const labelled = this.segmentation.named_words.filter(({ value }) => this.isVisible(value) && this.centres[value]).slice(0, MAX_LABELS);
    return labelled.map(({ value, word, colour }) => ({ low: this.centres[value], high: this.centres[value], colour: hex(colour), name: word, of: 1, strong: this.selectedValues.has(value), labelValue: value }));
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

  restore(parameters) {
    const vocabulary = linkedWords(parameters);
    byId("own-words").value = (vocabulary.words ?? []).join(", ");
    this.labelSplats(vocabulary, parameters.getAll("only"));
  }

  link(parameters) {
    if (!this.isShown) return;
    for (const word of this.vocabulary.words ?? ["*"]) parameters.append("named", word);
    for (const { value, word } of this.segmentation.named_words) if (this.selectedValues.has(value)) parameters.append("only", word);
  }

  render() {
    const { segmentation } = this;
    byId("unname").hidden = !segmentation;
    byId("unname").textContent = this.isShown ? "Show the scene's colours" : "Show the labels";
    byId("named").textContent = segmentation ? `${plural(segmentation.named_words.length, "word")} of ${formatCount(segmentation.word_count)} ${segmentation.named_words.length === 1 ? "labels" : "label"} splats; ${percent(segmentation.none / segmentation.splats)} of the splats have no label.` : "";
    byId("legend").replaceChildren(...(segmentation ? [...segmentation.named_words.map(entry => legendItem(entry, this)), unlabelledItem(segmentation)] : []));
  }
}

// The vocabulary of a link, as the service takes it.
function linkedWords(parameters) {
  const words = parameters.getAll("named");
  return words[0] === "*" ? {} : { words };
}

// The words that label splats, and the value of each splat: 0 for none, else that of its word.
async function segmentSplats(lift, vocabulary) {
  const body = { lift: lift.id, ...vocabulary };
  const segmentation = await post("/query/segment", body);
  return [segmentation, readNpy(await fetchBytes("/query/segment/labels", { body }))];
}

// The layer of labelled splats; hidden words have the neutral colour.
function wordLayer(segmentation, values, isVisible) {
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
