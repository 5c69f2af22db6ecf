// Two views of the scene with one camera. The left one keeps the questions of the page at the start of the comparison; the
// right one follows the page.
import { fetchAnswer, heatOf, questionLabel, linkedQuestions, paintedQuestions } from "./query.js";
import { byId, formatCount, el, notify } from "./dom.js";
import { fetchBytes, problemText } from "./service.js";

const RIGHT_PARAMETERS = ["beside", "camera", "layer", "show", "view"]; // that the left side leaves out

export class Comparison {
  // viewer(): the viewer of the right side. createViewer(canvas): one for the left. currentLink(): the link of the page.
  // hiddenSplats(): those that no side draws. onChange(): after the comparison began or ended.
  constructor({ viewer, createViewer, currentLink, hiddenSplats, onChange }) {
    Object.assign(this, { viewer, createViewer, currentLink, hiddenSplats, onChange, link: null, requestNumber: 0, lift: null });
    for (const button of document.querySelectorAll("[data-compare]")) button.addEventListener("click", () => (this.link ? this.end() : this.showLeft(this.currentLink())));
    byId("end-compare").addEventListener("click", () => this.end());
  }

  // Open another lift, which ends the comparison.
  setLift(lift) {
    this.lift = lift;
    this.loadedId = null;
    if (this.link) this.end();
  }

  // Show the questions of a link on the left side.
  async showLeft(link) {
    const request = ++this.requestNumber;
    this.link = leftOf(link);
    this.isLoaded = false;
    this.renderButtons();
    this.onChange();
    byId("beside-said").replaceChildren("Loading the left side\u2026");
    try {
      const { lift } = this;
      const questions = linkedQuestions(this.link);
      const [content] = await Promise.all([this.loadedId === lift.id ? null : fetchBytes(`/lifts/${lift.id}/splats`),
        ...questions.map(async question => Object.assign(question, await fetchAnswer(lift, question, this.link.getAll("negatives"))))]);
      if (request !== this.requestNumber) return;
      this.left ||= this.createViewer(byId("beside"));
      const { viewer, left } = this;
      left.origin = lift.origin;
      if (content) await left.load(content);
      if (request !== this.requestNumber) return;
      this.loadedId = lift.id;
      left.hide(this.hiddenSplats());
      viewer().pair(left);
      left.paint(paintedQuestions(questions), { heat: this.link.has("heat") ? heatOf(questions[0]) : null, hide: this.link.has("hide") });
      byId("beside-said").replaceChildren(...summary(questions));
      this.isLoaded = true;
    } catch (problem) {
      if (request !== this.requestNumber) return;
      notify(problemText(problem), true);
      this.end();
    }
  }

  end() {
    this.requestNumber += 1;
    this.link = null;
    this.isLoaded = false;
    this.renderButtons();
    this.onChange();
  }

  // Open the left side of a link, or close it where the link has none.
  restore(parameters) {
    if (parameters.has("beside")) return String(this.link) === parameters.get("beside") ? undefined : this.showLeft(parameters.get("beside"));
    return this.link ? this.end() : undefined;
  }

  renderButtons() {
    byId("stage").classList.toggle("comparing", Boolean(this.link));
    for (const button of document.querySelectorAll("[data-compare]")) {
      button.textContent = this.link ? "End the comparison" : "Compare";
      button.setAttribute("aria-pressed", String(Boolean(this.link)));
    }
  }
}

const leftOf = link => new URLSearchParams([...new URLSearchParams(link)].filter(([name]) => !RIGHT_PARAMETERS.includes(name)));

// The questions of a side with their colours.
const summary = questions => questions.map(question => el("span", { className: "asked", style: { "--mine": question.colour } }, el("span", { className: "swatch", "aria-hidden": "true" }),
  questionLabel(question), el("small", {}, question.answer ? ` ${formatCount(question.count)}${Number.isFinite(question.cut) && !question.sets.length ? ` from ${question.cut.toFixed(3)}` : ""}` : "")));
