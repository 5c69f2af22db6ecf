// Two views of the scene with one camera. The left one keeps the state of the page at the start of the comparison; the
// right one follows the page.
import { fetchAnswer, heatOf, questionLabel, linkedQuestions, paintedQuestions } from "./query.js";
import { byId, formatCount, el, notify } from "./dom.js";
import { liftTitle } from "./lifts.js";
import { wordLayer, linkedWords, segmentSplats } from "./labels.js";
import { fetchBytes, fetchJson, readNpy, problemText } from "./service.js";
import { fetchTitles } from "./objects.js";

const HINT = "Now query another word, move the slider or choose another scene. The left side stays as it is.";
const RIGHT_PARAMETERS = ["beside", "camera", "show", "view"]; // that the left side leaves out

export class Comparison {
  // viewer(): the viewer of the right side. createViewer(canvas): one for the left. currentLink(): the link of the page.
  // onChange(): after the comparison began or ended.
  constructor({ viewer, createViewer, currentLink, onChange }) {
    Object.assign(this, { viewer, createViewer, currentLink, onChange, link: null, requestNumber: 0 });
    for (const button of document.querySelectorAll("[data-compare]")) button.addEventListener("click", () => (this.link ? this.end() : this.showLeft(this.currentLink())));
    byId("end-compare").addEventListener("click", () => this.end());
  }

  // Show a link on the left side.
  async showLeft(link) {
    const request = ++this.requestNumber;
    this.link = new URLSearchParams([...new URLSearchParams(link)].filter(([name]) => !RIGHT_PARAMETERS.includes(name)));
    this.scene = null;
    this.renderButtons();
    this.onChange();
    byId("beside-said").replaceChildren("Loading the left side\u2026");
    try {
      const side = await this.loadSide(this.link);
      if (request !== this.requestNumber) return;
      this.left ||= this.createViewer(byId("beside"));
      const { viewer, left } = this;
      left.origin = side.lift.origin;
      if (this.loadedId !== side.lift.id) await left.load(side.content);
      if (request !== this.requestNumber) return;
      this.loadedId = side.lift.id;
      viewer().pair(left);
      left.paint(paintedQuestions(side.questions), { heat: side.heat, layer: side.layer, hide: this.link.has("hide") });
      this.scene = side.lift;
      byId("beside-said").replaceChildren(...summary(side.questions, side.lift, side.layerName));
    } catch (problem) {
      if (request !== this.requestNumber) return;
      notify(problemText(problem), true);
      this.end();
    }
  }

  async loadSide(link) {
    const lift = await fetchJson(`/lifts/${link.get("lift")}`);
    const questions = linkedQuestions(link);
    const [content, layer] = await Promise.all([this.loadedId === lift.id ? null : fetchBytes(`/lifts/${lift.id}/splats`), layerOf(lift, link),
      ...questions.map(async question => { if (question.sets.length) question.titles = await fetchTitles(lift, question.sets); }),
      ...questions.map(async question => Object.assign(question, await fetchAnswer(lift, question, link.getAll("negatives"))))]);
    return { lift, questions, content, layer, heat: link.has("heat") ? heatOf(questions[0]) : null, layerName: layer?.name };
  }

  end() {
    this.requestNumber += 1;
    this.link = null;
    this.left?.clear();
    this.loadedId = null;
    this.renderButtons();
    this.onChange();
  }

  // Open the left side of a link, or close it where the link has none.
  restore(parameters) {
    if (parameters.has("beside")) return String(this.link) === parameters.get("beside") ? undefined : this.showLeft(parameters.get("beside"));
    return this.link ? this.end() : undefined;
  }

  // The parameters that another lift takes over from the right side: words, and the camera if both share a frame.
  sharedParameters(lift) {
    if (!this.link) return null;
    const link = new URLSearchParams(this.currentLink());
    const sameFrame = this.scene && (this.scene.cameras === lift.cameras || this.scene.splats === lift.splats);
    const names = ["text", "negatives", "named", "only", "table", "what", "heat", "hide", "beside", ...(sameFrame ? ["camera", "view"] : [])];
    return new URLSearchParams([["lift", lift.id], ...[...link].filter(([name]) => names.includes(name))]);
  }

  renderButtons() {
    byId("stage").classList.toggle("comparing", Boolean(this.link));
    for (const button of document.querySelectorAll("[data-compare]")) {
      button.textContent = this.link ? "End the comparison" : "Compare";
      button.setAttribute("aria-pressed", String(Boolean(this.link)));
    }
  }

  // Write the questions of the right side below it.
  describeRight(questions, lift) {
    if (!this.link || !lift) return;
    const link = new URLSearchParams([...new URLSearchParams(this.currentLink())].filter(([name]) => !RIGHT_PARAMETERS.includes(name)));
    byId("right-said").replaceChildren(...(String(link) === String(this.link) ? [el("span", {}, HINT)] : summary(questions, lift)));
  }
}

// The questions of a side with their colours, the name of its layer, and its scene.
function summary(questions, lift, layerName) {
  const items = questions.map(question => el("span", { className: "asked", style: { "--mine": question.colour } }, el("span", { className: "swatch", "aria-hidden": "true" }),
    questionLabel(question), el("small", {}, question.answer ? ` ${formatCount(question.count)}${Number.isFinite(question.cut) && !question.sets.length ? ` from ${question.cut.toFixed(3)}` : ""}` : "")));
  return [...items, layerName && el("span", {}, layerName), el("small", {}, liftTitle(lift))].filter(Boolean);
}

// The layer of a link: its labels or its colours; null if it has none.
async function layerOf(lift, link) {
  if (link.has("named")) {
    const [segmentation, values] = await segmentSplats(lift, linkedWords(link));
    const only = link.getAll("only");
    const isVisible = value => !only.length || segmentation.named_words.some(entry => entry.value === value && only.includes(entry.word));
    return { ...wordLayer(segmentation, values, isVisible), name: "labels" };
  }
  const layer = link.get("what");
  const input = [...document.querySelectorAll("input[name=layer]")].find(({ value }) => value === layer); // a link may have any value
  if (!input || ["rgb", "depth", "photo"].includes(layer)) return null;
  return { colours: readNpy(await fetchBytes(`/lifts/${lift.id}/colours?what=${layer}`)), cover: 1, name: input.nextSibling.textContent };
}
