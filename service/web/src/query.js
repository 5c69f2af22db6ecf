// The panel Query: questions of words or examples, a colour each; their answers, thresholds and objects.
import { byId, formatCount, el, percent, plural, notify } from "./dom.js";
import { COLOURS, countFrom, drawHistogram, histogram, passing, rgb } from "./painter.js";
import { changedFields, defaultFields, linkFields, readFields, queryString } from "./question.js";
import { fetchBytes, fetchJson, readNpy, problemText } from "./service.js";
import { Completions } from "./completions.js";

const MAX_QUESTIONS = COLOURS.length; // at a time
const MAX_COMPLETIONS = 8;
const MAX_SCENE_WORDS = 24; // words of the scene's objects
const OBJECTS_DELAY = 350; // ms from the slider's last move to the request for objects

export class QueryPanel {
  // onChange(): colours, boxes or the link must be updated. flyToBox(box): move the camera. ownNames(): names that people
  // gave to objects.
  constructor({ onChange, flyToBox, ownNames }) {
    Object.assign(this, { onChange, flyToBox, ownNames, questions: [], activeIndex: 0, objectIndex: -1, negatives: [], requestNumber: 0, lift: null });
    byId("query").addEventListener("submit", event => { event.preventDefault(); this.fromForm(); });
    this.completions = new Completions(async text => ({ words: [...this.ownNames().filter(({ word }) => word.toLowerCase().startsWith(text.toLowerCase())).map(({ word }) => ({ word, typed: word })), ...(await this.suggestWords(text)).words] }));
    byId("but").addEventListener("input", () => { this.negativesTyped = true; });
    byId("clear").addEventListener("click", () => this.reset(true));
    byId("heat").addEventListener("change", () => this.onChange());
    byId("cut").addEventListener("input", () => this.setThreshold(Number(byId("cut").value)));
    byId("auto").addEventListener("click", () => this.useAutoThreshold());
    new ResizeObserver(() => this.drawBars()).observe(byId("histogram"));
  }

  get current() {
    return this.questions[this.activeIndex];
  }

  // Open another lift and drop all answers of the one before.
  setLift(lift) {
    this.lift = lift;
    namesByTerm.clear();
    this.completionCache = new Map(); // promises by typed text
    this.sceneWords = [];
    const wordless = Boolean(lift) && lift.text_space === "none";
    if (lift && !wordless) this.suggestWords("").then(({ scene_words: sceneWords }) => { if (lift === this.lift) { this.sceneWords = sceneWords; this.showAdvice(); } }).catch(() => {});
    byId("words").disabled = byId("but").disabled = wordless;
    byId("words").placeholder = wordless ? "These features have no text encoder: click an object" : "What are you looking for?";
    this.reset(false);
  }

  reset(notifyChange) {
    this.requestNumber += 1;
    this.questions = [];
    this.activeIndex = 0;
    this.objectIndex = -1;
    this.negatives = [];
    byId("words").value = byId("but").value = "";
    byId("stage").classList.remove("asking"); // replies that still come are dropped
    this.render();
    if (notifyChange) this.onChange();
  }

  // Completions of a typed text, and words of the scene's objects. Each text is requested once.
  suggestWords(text) {
    const { lift, completionCache: cache } = this;
    if (!cache.has(text)) cache.set(text, fetchJson(`/query/suggested_words?${queryString({ lift: lift.id, text, limit: MAX_COMPLETIONS })}`));
    return cache.get(text);
  }

  // Ask a word in place of a question's text, or as the only question.
  askWord(word, question = null) {
    if (question) Object.assign(question, { text: [word], wordOf: undefined, threshold: "auto" });
    else this.questions = [newQuestion({ text: [word] }, 0)];
    byId("words").value = this.questions.flatMap(({ text }) => text).join(", ");
    this.activeIndex = Math.max(0, this.questions.indexOf(question));
    return this.ask(question);
  }

  excludeWord(word) {
    byId("but").value = [...splitWords(byId("but").value), word].join(", ");
    return this.ask();
  }

  fromForm() {
    this.completions.close();
    const texts = splitWords(byId("words").value);
    if (!this.negativesTyped && String(texts) !== String(this.questions.map(({ text }) => text.join()))) byId("but").value = ""; // negatives of other words
    this.negativesTyped = false;
    if (!texts.length) return this.questions.length ? this.ask() : undefined;
    if (texts.length > MAX_QUESTIONS) notify(`At most ${MAX_QUESTIONS} words at a time: the first ${MAX_QUESTIONS} are used.`);
    // Typed words replace all questions, also those of clicks.
    this.questions = texts.slice(0, MAX_QUESTIONS).map((text, index) => {
      const sets = this.ownNames().filter(({ word }) => word.toLowerCase() === text.toLowerCase()).map(({ term }) => term);
      return newQuestion(sets.length ? { sets } : { text: [text] }, index);
    });
    this.activeIndex = 0;
    return this.ask();
  }

  // Add an example to the current question, or begin one with it; with `less`, a negative example.
  askExample(notation, less) {
    if (less && this.current) {
      this.current.unlike.push(notation);
    } else if (this.current && this.current.like.length) {
      if (!this.current.like.includes(notation)) this.current.like.push(notation);
    } else {
      if (less) return notify("Type a word or click an example first; then shift-click a negative example.");
      this.questions = [newQuestion({ like: [notation] }, 0)];
      this.activeIndex = 0;
      byId("words").value = "";
    }
    this.current.threshold = "auto";
    return this.ask(this.current);
  }

  // The sets of the current question, or the one that its word answers for.
  get sets() {
    return this.current?.wordOf ?? this.current?.sets ?? [];
  }

  // Show objects or selections, by the word that answers for them, if there is one.
  askSets(sets, word = null) {
    byId("words").value = byId("but").value = "";
    if (!sets.length) return this.reset(true);
    this.questions = [newQuestion(word ? { text: [word], wordOf: sets } : { sets }, 0)];
    this.activeIndex = 0;
    return this.ask();
  }

  // Open the questions of a link.
  restore(parameters) {
    byId("words").value = parameters.getAll("text").join(", ");
    byId("but").value = parameters.getAll("negatives").join(", ");
    const questions = linkedQuestions(parameters);
    if (!questions.length) return undefined;
    this.questions = questions;
    byId("heat").checked = parameters.has("heat");
    return this.ask();
  }

  link(parameters) {
    const negatives = this.questions.length ? this.negatives : []; // all questions have the same ones
    for (const [name, value] of queryString({ ...linkFields(this.questions), negatives })) parameters.append(name, value);
    if (byId("heat").checked) parameters.set("heat", "1");
  }

  // The body of a request for a question.
  requestBody(question) {
    return requestBody(this.lift, question, this.negatives);
  }

  // The same as parameters of an address.
  requestParameters(question, options = {}) {
    return queryString({ ...this.requestBody(question), ...options });
  }

  async ask(only = null) {
    if (!this.lift) return;
    const turn = ++this.requestNumber;
    const isPending = question => !question.answer && !question.problem; // its reply will be dropped
    const pending = only ? this.questions.filter(question => question === only || isPending(question)) : this.questions;
    if (pending.length === this.questions.length) this.negatives = splitWords(byId("but").value); // other answers were made without them
    for (const question of pending) Object.assign(question, { answer: null, objects: [], problem: null });
    this.objectIndex = -1;
    byId("stage").classList.add("asking");
    this.render();
    await Promise.all(pending.map(question => this.loadAnswer(question, turn)));
    if (turn !== this.requestNumber) return; // a later request replaces this one
    byId("stage").classList.remove("asking");
    this.render();
    this.onChange();
    const failed = pending.find(question => question.problem);
    if (failed && !failed.problem.nearest) notify(problemText(failed.problem), true);
    await Promise.all(pending.map(question => this.loadObjects(question)));
  }

  // Once the service answers again: repeat the questions that failed without a reply.
  resume() {
    if (this.questions.some(({ problem }) => problem && !problem.status)) this.ask();
  }

  async loadAnswer(question, turn) {
    try {
      const state = await fetchAnswer(this.lift, question, this.negatives);
      if (turn !== this.requestNumber) return;
      Object.assign(question, state);
      if (question.threshold === "auto") question.auto = state.answer.threshold.value;
    } catch (problem) {
      if (turn !== this.requestNumber) return;
      question.problem = problem;
      const [kind, index] = String(problem.argument).split("."); // like.1 is the second value of the field like
      if (!["like", "unlike"].includes(kind)) return;
      question[kind]?.splice(Number(index), 1); // such as a pixel without a splat
      if (!question.text.length && !question.like.length) this.questions = this.questions.filter(entry => entry !== question);
      this.activeIndex = Math.max(0, Math.min(this.activeIndex, this.questions.length - 1));
    }
  }

  // Load the selected objects of a question, with their boxes.
  async loadObjects(question) {
    question.objectRequest = (question.objectRequest || 0) + 1;
    const request = question.objectRequest;
    if (!question.answer || !isPainted(question) || !question.count) {
      question.objects = [];
    } else {
      try {
        const answer = await fetchJson(`/query/objects?${this.requestParameters(question)}`);
        if (request !== question.objectRequest) return;
        question.objects = answer.objects;
      } catch (problem) {
        question.objects = [];
        question.objectsProblem = problemText(problem);
      }
    }
    if (!this.questions.includes(question)) return;
    this.render();
    this.onChange();
  }

  // Repaint by a threshold of the slider, without a request; objects are loaded once it rests.
  setThreshold(value) {
    const question = this.current;
    if (!question?.answer) return;
    question.cut = question.threshold = value;
    question.paintedScores = question.scores;
    question.count = countFrom(question.scores, value);
    question.objects = [];
    this.objectIndex = -1;
    this.render();
    this.onChange();
    clearTimeout(this.objectsTimer);
    this.objectsTimer = setTimeout(() => this.loadObjects(question), OBJECTS_DELAY);
  }

  useAutoThreshold() {
    if (!this.current?.answer || this.current.threshold === "auto") return;
    this.current.threshold = "auto";
    this.ask(this.current);
  }

  // The questions that the viewer paints, each with its threshold.
  paintedQuestions() {
    return paintedQuestions(this.questions);
  }

  heatScores() {
    return byId("heat").checked ? heatOf(this.current) : null;
  }

  boxes() {
    return this.questions.filter(question => question.answer && isPainted(question)).flatMap(question => (question.objects || []).map((object, index) => ({
      ...object.box, colour: question.colour, name: questionLabel(question), objectIndex: index, of: question.objects.length,
      strong: question === this.current && index === this.objectIndex, question,
    })));
  }

  selectObject(question, objectIndex) {
    this.activeIndex = this.questions.indexOf(question);
    this.objectIndex = objectIndex;
    this.render();
    this.onChange();
    this.flyToBox(question.objects[objectIndex].box);
  }

  render() {
    byId("chips").replaceChildren(...this.questions.map((question, index) => this.chipOf(question, index)));
    byId("clear").hidden = !this.questions.length;
    byId("start").hidden = Boolean(this.questions.length);
    byId("found").hidden = !this.current;
    this.showAdvice();
    if (!this.current) return;
    const { current: question } = this;
    byId("found").style.setProperty("--mine", question.colour);
    byId("title").textContent = questionLabel(question);
    byId("scale").hidden = !question.answer || question.sets.length > 0;
    byId("examples").replaceChildren(...["like", "unlike"].flatMap(kind => question[kind].map(term => el("li", {},
      el("button", { type: "button", title: "Remove this example", on: { click: () => this.removeExample(kind, term) } },
        `${kind === "like" ? "more of" : "less of"} ${describeTerm(term)} \u00d7`)))));
    if (question.answer) {
      const slider = byId("cut");
      slider.min = question.low;
      slider.max = question.high;
      slider.step = (question.high - question.low) / 1000 || 0.001;
      slider.value = Number.isFinite(question.cut) ? question.cut : question.high;
    }
    this.describe();
    this.drawBars();
    this.listObjects();
  }

  chipOf(question, index) {
    const splatCount = question.answer && isPainted(question) ? formatCount(question.count) : "";
    const status = question.answer ? (question.sets.length ? formatCount(question.count) : question.answer.present === false && !splatCount ? "absent" : isUncertain(question) ? ["not sure", splatCount].filter(Boolean).join(" \u00b7 ") : splatCount) : question.problem ? (question.problem.nearest ? "unknown word" : "!") : "\u2026";
    return el("li", { className: ["chip", question === this.current && "now", isUncertain(question) && "unsure"].filter(Boolean).join(" "), style: { "--mine": question.colour } },
      el("button", { type: "button", className: "pick", "aria-pressed": String(question === this.current),
        on: { click: () => { this.activeIndex = index; this.objectIndex = -1; this.render(); this.onChange(); } } },
      el("span", { className: "swatch", "aria-hidden": "true" }), questionLabel(question), " ", el("small", {}, status)),
      el("button", { type: "button", className: "away", "aria-label": `Remove ${questionLabel(question)}`,
        on: { click: () => this.removeQuestion(index) } }, "\u00d7"));
  }

  removeQuestion(index) {
    this.questions.splice(index, 1);
    this.activeIndex = Math.max(0, Math.min(this.activeIndex, this.questions.length - 1));
    this.objectIndex = -1;
    byId("words").value = this.questions.flatMap(question => question.text).join(", ");
    this.render();
    this.onChange();
  }

  removeExample(kind, term) {
    this.current[kind] = this.current[kind].filter(example => example !== term);
    if (!this.current.text.length && !this.current.like.length) return this.removeQuestion(this.activeIndex);
    return this.ask(this.current);
  }

  // Below the box: the word that stands for a text, suggestions for an unknown one, and competing words.
  showAdvice() {
    const { current: question } = this;
    const paragraphs = question ? adviceLines(question, this) : [];
    byId("advice").hidden = !paragraphs.length;
    byId("advice").replaceChildren(...paragraphs);
    byId("advice").classList.toggle("unsure", Boolean(question && isUncertain(question)));
    byId("here").hidden = Boolean(this.questions.length) || !this.sceneWords.length;
    byId("here-words").replaceChildren(...this.sceneWords.slice(0, MAX_SCENE_WORDS).map(word => button(plainWord(word), () => this.askWord(word))));
  }

  // The number of selected splats, and the reason for it.
  describe() {
    const { current: question } = this;
    const answer = question.answer;
    byId("answer").classList.toggle("unsure", isUncertain(question));
    byId("slider-value").textContent = answer && Number.isFinite(question.cut) ? question.cut.toFixed(3) : "";
    byId("auto").disabled = !answer || question.threshold === "auto";
    if (!answer) {
      byId("answer").textContent = question.problem ? (question.problem.nearest ? "" : problemText(question.problem)) : "Searching\u2026";
      byId("why").textContent = "";
    } else if (question.sets.length && !question.count) {
      byId("answer").textContent = "Nothing is selected.";
      byId("why").textContent = "Add splats with the brush or the box.";
    } else if (!isPainted(question) && answer.present === false) {
      byId("answer").textContent = `${quoteWords(question)} is not in this scene.`;
      byId("why").textContent = answer.reason;
    } else if (!isPainted(question)) {
      byId("answer").textContent = question.text.length ? `No splats stand out for ${quoteWords(question)}.` : "No similar splats stand out.";
      byId("why").textContent = "Try another word, or click an example.";
    } else {
      byId("answer").textContent = question.count
        ? `${isUncertain(question) ? "Not sure: " : ""}${plural(question.count, "splat")} of ${formatCount(question.scores.length)} (${percent(question.count / question.scores.length)}).`
        : "No splat has a score above the threshold.";
      byId("why").textContent = thresholdReason(question);
    }
  }

  drawBars() {
    if (this.current?.answer) drawHistogram(byId("histogram"), { ...this.current, cut: isPainted(this.current) ? this.current.cut : Infinity, auto: this.current.auto ?? null });
  }

  listObjects() {
    const { current: question } = this;
    const objects = question.objects || [];
    byId("objects").replaceChildren(...(question.sets.length === 1 ? [] : objects).map((object, index) => el("li", {},
      el("button", { type: "button", className: "object", "aria-pressed": String(index === this.objectIndex), on: { click: () => this.selectObject(question, index) } },
        el("b", {}, String(index + 1)), el("span", {}, plural(object.splats, "splat"), el("small", {}, boxSize(object.box))),
        el("span", { className: "score", title: "mean score" }, object.score.toFixed(2))))));
    byId("apart").textContent = question.objectsProblem && !objects.length ? question.objectsProblem : "";
  }
}

// The questions of a link.
export function linkedQuestions(parameters) {
  const values = name => parameters.getAll(name);
  const terms = values("text").slice(0, MAX_QUESTIONS).map(text => ({ text: [text] }));
  if (values("like").length) terms.push({ like: values("like") });
  if (values("sets").length) terms.push({ sets: values("sets") });
  if (values("unlike").length && terms.length) terms.at(-1).unlike = values("unlike");
  return terms.map((term, index) => newQuestion({ ...readFields(parameters, index), ...term }, index));
}

// The body of a request for a question of a lift.
function requestBody(lift, question, negatives) {
  const keepsAbsent = question.threshold !== "auto" && !question.answer?.present; // a threshold that was set selects all the same
  return { lift: lift.id, ...changedFields({ ...question, negatives: question.sets.length ? [] : negatives, ...(keepsAbsent && { absent: "keep" }) }) };
}

// The answer to a question, its scores, those that are painted, their range, threshold and histogram.
export async function fetchAnswer(lift, question, negatives) {
  const path = (route, changes, options = {}) => `${route}?${queryString({ ...requestBody(lift, { ...question, ...changes }, negatives), ...options })}`;
  const [answer, scores, selected] = await Promise.all([
    fetchJson(path("/query", {}, { top: 1 })),
    question.sets.length ? fetchBytes(path("/query/selection")).then(content => Float32Array.from(readNpy(content)))
      : fetchBytes(path("/query/scores", { threshold: "auto" })).then(readNpy),
    question.threshold === "auto" && !question.sets.length ? fetchBytes(path("/query/selection")).then(readNpy) : null,
  ]);
  const { min = 0, max = 0 } = answer.statistics;
  const cut = answer.threshold.value ?? Infinity;
  return { answer, scores, paintedScores: selected ? passing(scores, selected, cut) : scores, low: min, high: max, cut, count: answer.count, bins: histogram(scores, min, max) };
}

// The input of the painter: questions with a selection, and the one whose scores are shown as heat.
export const paintedQuestions = questions => questions.filter(question => question.answer && isPainted(question))
  .map(question => ({ question, scores: question.paintedScores, cut: question.cut, high: question.high, rgb: rgb(question.colour) }));
export const heatOf = question => (question?.answer ? { scores: question.scores, low: question.low, high: question.high } : null);

const newQuestion = (terms, index) => ({ ...defaultFields(), objects: [], ...terms, colour: COLOURS[index % COLOURS.length] });
const splitWords = text => text.split(",").map(word => word.trim()).filter(Boolean);
const isPainted = question => question.threshold !== "auto" || (question.answer.clear && question.answer.present !== false);
const describeTerm = term => term.replace(/^splat:/, "splat ").replace(/^(.*):(box|stroke):[\d,\s]+$/, "a $2 of $1");
export const namesByTerm = new Map(); // names of objects and selections by their terms
export const questionLabel = question => question.text.join(", ") || question.sets.map(set => namesByTerm.get(set) || set.replace(/^object:(\d+)$/, (_, number) => `object ${Number(number) + 1}`).replace(/^selection:.*/, "a selection")).join(", ") || (question.like.length > 1 ? `like ${question.like.length} examples` : `like ${describeTerm(question.like[0] || "")}`);
const quoteWords = question => (question.text.length ? `\u201c${question.text.join(", ")}\u201d` : "Such an object");
const boxSize = ({ low, high }) => ` ${low.map((value, axis) => (high[axis] - value).toPrecision(2)).join(" \u00d7 ")}`;

// The object may be there, or other words are nearer to the selection.
const isUncertain = ({ text, answer }) => Boolean(text.length && answer && answer.present !== false
  && (!answer.clear || answer.rivals.length || (answer.present === null && answer.presence !== null)));
const plainWord = word => word.replace(/\s*\(.*\).*$/, "") || word;
const button = (label, onClick) => el("button", { type: "button", on: { click: onClick } }, label);
const paragraph = (...parts) => el("p", {}, ...parts);

function adviceLines(question, panel) {
  const { answer, problem, text } = question;
  const paragraphs = (answer?.wording || []).map(match => paragraph(`\u201c${match.text}\u201d ${match.match === "negation" ? "excludes" : "is matched to"} `, el("b", {}, match.word), "."));
  if (problem?.nearest) {
    const suggestions = problem.nearest.length ? problem.nearest : panel.sceneWords.slice(0, 5);
    paragraphs.push(paragraph(`\u201c${text.join(", ")}\u201d is not in the list of words of this scene. `, suggestions.length ? "Try " : "Try another word.",
      ...suggestions.map(word => button(plainWord(word), () => panel.askWord(word, question)))));
  }
  const rivals = (answer?.rivals || []).filter(word => !panel.negatives.includes(word));
  if (answer?.present === false && rivals.length) paragraphs.push(paragraph(`\u201c${text.join(", ")}\u201d is not in this scene. Try `, ...rivals.map(word => button(plainWord(word), () => panel.askWord(word, question)))));
  if (isUncertain(question) && rivals.length) {
    paragraphs.push(paragraph(`Not sure: ${rivals.length > 1 ? "these words are" : "this word is"} nearer. `, ...rivals.flatMap(word => [button(plainWord(word), () => panel.askWord(word, question)), button(`but not ${plainWord(word)}`, () => panel.excludeWord(word))])));
  } else if (isUncertain(question)) paragraphs.push(paragraph("Not sure: the selected splats hardly stand out."));
  return paragraphs;
}

// The reason for the selection, in the service's words.
function thresholdReason({ answer, threshold, sets }) {
  if (sets.length) return "";
  if (typeof threshold === "number") return "You set this threshold. The dashes mark the automatic one.";
  return answer.present === null && answer.presence !== null ? answer.reason : answer.threshold.explanation;
}
