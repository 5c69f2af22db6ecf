// The panel of asking: words and examples, each a question with a colour; what they found, and where to cut.
import { at, count, el, percent, plural, notify } from "./dom.js";
import { countFrom, drawHistogram, histogram, passing } from "./histogram.js";
import { COLOURS, rgb } from "./painter.js";
import { asked, blank, linked, notation, read, search } from "./question.js";
import { bytes, json, npy, words } from "./service.js";
import { Completing } from "./completing.js";

const MOST = COLOURS.length; // questions at a time
const COMPLETIONS = 8;
const HERE = 24; // words for what is in the scene
const SOON = 350; // ms after the slider's last move, until the things are looked for anew

export class Ask {
  // changed: called when colours, boxes or the link must follow; fly: with a box to look at.
  constructor({ changed, fly }) {
    Object.assign(this, { changed, fly, questions: [], active: 0, thing: -1, negatives: [], heat: false, turn: 0, lift: null });
    at("query").addEventListener("submit", event => { event.preventDefault(); this.fromForm(); });
    Object.assign(at("example"), { maxLength: notation.maxLength });
    this.completing = new Completing(text => this.askable(text));
    at("but").addEventListener("input", () => { this.butTyped = true; });
    at("by-example").addEventListener("submit", event => { event.preventDefault(); this.typed(false); });
    at("less").addEventListener("click", () => this.typed(true));
    at("clear").addEventListener("click", () => this.reset(true));
    at("heat").addEventListener("change", () => { this.heat = at("heat").checked; this.changed(); });
    at("previous").addEventListener("click", () => this.step(-1));
    at("next").addEventListener("click", () => this.step(1));
    at("cut").addEventListener("input", () => this.cut(Number(at("cut").value)));
    at("auto").addEventListener("click", () => this.automatic());
    at("nearest").addEventListener("click", () => this.nearest());
    new ResizeObserver(() => this.bars()).observe(at("histogram"));
  }

  get now() {
    return this.questions[this.active];
  }

  // Another lift: nothing of the old one's answers stays.
  of(lift) {
    this.lift = lift;
    naming.clear();
    this.known = new Map(); // of completions
    this.sceneWords = [];
    const wordless = Boolean(lift) && lift.text_space === "none" && !this.table;
    if (lift && !wordless) this.askable("").then(({ scene_words: sceneWords }) => { if (lift === this.lift) { this.sceneWords = sceneWords; this.advise(); } }).catch(() => {});
    at("words").disabled = at("but").disabled = wordless;
    at("words").placeholder = wordless ? "These features have no words: click a thing" : "What are you looking for?";
    this.reset(false);
  }

  reset(changed) {
    this.turn += 1;
    this.questions = [];
    this.active = 0;
    this.thing = -1;
    this.negatives = [];
    at("words").value = at("but").value = "";
    at("stage").classList.remove("asking"); // what is on its way is late
    this.show();
    if (changed) this.changed();
  }

  // What can be asked: completions of a text that is typed, and words for what is here. A text is asked once.
  askable(text) {
    const { lift, known } = this;
    if (!known.has(text)) known.set(text, json(`/query/words?${search({ lift: lift.id, text, limit: COMPLETIONS })}`));
    return known.get(text);
  }

  // A word in place of one that was typed, or beside those that are asked.
  word(word, question = null) {
    if (question) Object.assign(question, { text: [word], threshold: "auto" });
    else this.questions = [fresh({ text: [word] }, 0)];
    at("words").value = this.questions.flatMap(({ text }) => text).join(", ");
    this.active = Math.max(0, this.questions.indexOf(question));
    return this.ask(question);
  }

  butNot(word) {
    at("but").value = [...split(at("but").value), word].join(", ");
    return this.ask();
  }

  fromForm() {
    this.completing.close();
    const texts = split(at("words").value);
    if (!this.butTyped && String(texts) !== String(this.questions.map(({ text }) => text.join()))) at("but").value = ""; // it was of other words
    this.butTyped = false;
    if (!texts.length) return this.questions.length ? this.ask() : undefined;
    if (texts.length > MOST) notify(`Only the first ${MOST} are asked at a time.`);
    // New words are a new question, also after a click.
    this.questions = texts.slice(0, MOST).map((text, place) => fresh({ text: [text] }, place));
    this.active = 0;
    return this.ask();
  }

  // A click: more of what is there; with `less`, less of it in the question that is on the screen.
  example(notation, less) {
    if (less && this.now) {
      this.now.unlike.push(notation);
    } else if (this.now && this.now.like.length) {
      if (!this.now.like.includes(notation)) this.now.like.push(notation);
    } else {
      if (less) return notify("First say what you look for; then shift-click what it is not.");
      this.questions = [fresh({ like: [notation] }, 0)];
      this.active = 0;
      at("words").value = "";
    }
    this.now.threshold = "auto";
    return this.ask(this.now);
  }

  // Things or a selection, as they are.
  hold(sets) {
    at("words").value = at("but").value = "";
    if (!sets.length) return this.reset(true);
    this.questions = [fresh({ sets }, 0)];
    this.active = 0;
    return this.ask();
  }

  // Another example in the place of one, such as a larger mask.
  swap(old, term) {
    for (const question of this.questions) {
      for (const kind of ["like", "unlike"]) question[kind] = question[kind].map(known => (known === old ? term : known));
    }
    this.now.threshold = "auto";
    return this.ask(this.now);
  }

  typed(less) {
    const notation = at("example").value.trim();
    if (!notation) return;
    at("example").value = "";
    this.example(notation, less);
  }

  // From a link.
  restore(parameters) {
    at("words").value = parameters.getAll("text").join(", ");
    at("but").value = parameters.getAll("negatives").join(", ");
    const questions = linkedQuestions(parameters);
    if (!questions.length) return undefined;
    this.questions = questions;
    at("heat").checked = this.heat = parameters.get("layer") === "attention" || parameters.has("heat");
    return this.ask();
  }

  link(parameters) {
    const negatives = this.questions.length ? this.negatives : []; // the same of all
    for (const [name, value] of search({ ...linked(this.questions), negatives })) parameters.append(name, value);
    if (this.heat) parameters.set("heat", "1");
  }

  // What the service is asked by a question.
  body(question) {
    return request(this.lift, question, this.negatives);
  }

  // The same in an address.
  parameters(question, more = {}) {
    return search({ ...this.body(question), ...more });
  }

  async ask(only = null) {
    if (!this.lift) return;
    const mine = ++this.turn;
    const waits = question => !question.answer && !question.problem; // what it was asked last is late from here on
    const anew = only ? this.questions.filter(question => question === only || waits(question)) : this.questions;
    if (anew.length === this.questions.length) this.negatives = split(at("but").value); // else the others' answers are without
    for (const question of anew) Object.assign(question, { answer: null, things: [], problem: null, anyway: false });
    this.thing = -1;
    at("stage").classList.add("asking");
    this.show();
    await Promise.all(anew.map(question => this.answer(question, mine)));
    if (mine !== this.turn) return; // a later question was asked meanwhile
    at("stage").classList.remove("asking");
    this.show();
    this.changed();
    const wrong = anew.find(question => question.problem);
    if (wrong && !wrong.problem.nearest) notify(words(wrong.problem), true);
    await Promise.all(anew.map(question => this.things(question)));
  }

  // Once the service is back: what it did not answer.
  resume() {
    if (this.questions.some(({ problem }) => problem && !problem.status)) this.ask();
  }

  async answer(question, mine) {
    try {
      const got = await answered(this.lift, question, this.negatives);
      if (mine !== this.turn) return;
      Object.assign(question, got);
      if (question.threshold === "auto") question.auto = got.answer.threshold.value;
      else if (question.auto === undefined) question.auto = await this.automaticCut(question);
    } catch (problem) {
      if (mine !== this.turn) return;
      question.problem = problem;
      if (!String(problem.argument).includes("like")) return;
      const [kind, place] = String(problem.argument).split("."); // like.1 is the second that was sent as like
      question[kind]?.splice(Number(place), 1); // a pixel beside the scene is no example
      if (!question.text.length && !question.like.length) this.questions = this.questions.filter(known => known !== question);
      this.active = Math.max(0, Math.min(this.active, this.questions.length - 1));
    }
  }

  async automaticCut(question) {
    return (await json(`/query?${this.parameters({ ...question, threshold: "auto" }, { top: 0 })}`)).threshold.value;
  }

  // The things that a question found, with their boxes.
  async things(question) {
    question.looked = (question.looked || 0) + 1;
    const mine = question.looked;
    if (!question.answer || !lit(question) || !question.count) {
      question.things = [];
    } else {
      try {
        const found = await json(`/query/objects?${this.parameters(question)}`);
        if (mine !== question.looked) return;
        question.things = found.objects;
      } catch (problem) {
        question.things = [];
        question.nothings = problem.expected ? `The objects cannot be separated here: ${problem.expected}.` : words(problem);
      }
    }
    if (!this.questions.includes(question)) return;
    this.show();
    this.changed();
  }

  // The slider: no request, only colours; things follow when it rests.
  cut(value) {
    const question = this.now;
    if (!question?.answer) return;
    question.cut = question.threshold = value;
    question.shown = question.scores;
    question.anyway = true;
    question.count = countFrom(question.scores, value);
    question.things = [];
    this.thing = -1;
    this.show();
    this.changed();
    clearTimeout(this.soon);
    this.soon = setTimeout(() => this.things(question), SOON);
  }

  // What is not there has no cut of its own: its best hundredth is shown.
  nearest() {
    const { now } = this;
    now.anyway = true;
    if (now.answer.present === false) {
      now.cut = now.threshold = now.answer.statistics.q99;
      now.shown = now.scores;
      now.count = countFrom(now.scores, now.cut);
    }
    this.show();
    this.changed();
    this.things(now);
  }

  automatic() {
    if (!this.now?.answer || this.now.threshold === "auto") return;
    this.now.threshold = "auto";
    this.ask(this.now);
  }

  step(by) {
    const things = this.now?.things || [];
    if (!things.length) return;
    this.thing = (this.thing + by + things.length + (this.thing < 0 && by < 0 ? 1 : 0)) % things.length;
    this.show();
    this.changed();
    this.fly(things[this.thing].box);
  }

  // What the viewer paints: the questions that have an answer, each with its cut.
  painted() {
    return painted(this.questions);
  }

  heated() {
    return this.heat ? heated(this.now) : null;
  }

  boxes() {
    return this.questions.filter(question => question.answer && lit(question)).flatMap(question => (question.things || []).map((thing, place) => ({
      ...thing.box, colour: question.colour, name: label(question), thing: place, of: question.things.length,
      strong: question === this.now && place === this.thing, question,
    })));
  }

  choose(question, thing) {
    this.active = this.questions.indexOf(question);
    this.thing = thing;
    this.show();
    this.changed();
    this.fly(question.things[thing].box);
  }

  show() {
    at("chips").replaceChildren(...this.questions.map((question, place) => this.chip(question, place)));
    at("clear").hidden = !this.questions.length;
    at("start").hidden = Boolean(this.questions.length);
    at("found").hidden = !this.now;
    this.advise();
    if (!this.now) return;
    const { now } = this;
    at("found").style.setProperty("--mine", now.colour);
    at("title").textContent = label(now);
    at("scale").hidden = !now.answer || now.sets.length > 0;
    at("examples").replaceChildren(...["like", "unlike"].flatMap(kind => now[kind].map(term => el("li", {},
      el("button", { type: "button", title: "Take this example away", on: { click: () => this.drop(kind, term) } },
        `${kind === "like" ? "more of" : "less of"} ${shown(term)} \u00d7`)))));
    if (now.answer) {
      const slider = at("cut");
      slider.min = now.low;
      slider.max = now.high;
      slider.step = (now.high - now.low) / 1000 || 0.001;
      slider.value = Number.isFinite(now.cut) ? now.cut : now.high;
    }
    this.describe();
    this.bars();
    this.list();
  }

  chip(question, place) {
    const found = question.answer && lit(question) ? count(question.count) : "";
    const numbers = question.answer ? (question.sets.length ? count(question.count) : question.answer.present === false && !found ? "not here" : unsure(question) ? ["not sure", found].filter(Boolean).join(" \u00b7 ") : found) : question.problem ? (question.problem.nearest ? "not a word here" : "!") : "\u2026";
    return el("li", { className: ["chip", question === this.now && "now", unsure(question) && "unsure"].filter(Boolean).join(" "), style: { "--mine": question.colour } },
      el("button", { type: "button", className: "pick", "aria-pressed": String(question === this.now),
        on: { click: () => { this.active = place; this.thing = -1; this.show(); this.changed(); } } },
      el("span", { className: "swatch", "aria-hidden": "true" }), label(question), " ", el("small", {}, numbers)),
      el("button", { type: "button", className: "away", "aria-label": `Take ${label(question)} away`,
        on: { click: () => this.take(place) } }, "\u00d7"));
  }

  take(place) {
    this.questions.splice(place, 1);
    this.active = Math.max(0, Math.min(this.active, this.questions.length - 1));
    this.thing = -1;
    at("words").value = this.questions.flatMap(question => question.text).join(", ");
    this.show();
    this.changed();
  }

  drop(kind, term) {
    this.now[kind] = this.now[kind].filter(known => known !== term);
    if (!this.now.text.length && !this.now.like.length) return this.take(this.active);
    return this.ask(this.now);
  }

  // Below the box: what a word was asked as, words in place of one that is not known here, and those that compete.
  advise() {
    const { now } = this;
    const lines = now ? advice(now, this) : [];
    at("advice").hidden = !lines.length;
    at("advice").replaceChildren(...lines);
    at("advice").classList.toggle("unsure", Boolean(now && unsure(now)));
    at("here").hidden = Boolean(this.questions.length) || !this.sceneWords.length;
    at("here-words").replaceChildren(...this.sceneWords.slice(0, HERE).map(word => button(spoken(word), () => this.word(word))));
  }

  // The number of selected splats, and the reason for it.
  describe() {
    const { now } = this;
    const answer = now.answer;
    at("answer").classList.toggle("unsure", unsure(now));
    at("slider-value").textContent = answer && Number.isFinite(now.cut) ? now.cut.toFixed(3) : "";
    at("auto").disabled = !answer || now.threshold === "auto";
    at("nearest").hidden = !answer || lit(now) || now.sets.length > 0;
    if (!answer) {
      at("answer").textContent = now.problem ? (now.problem.nearest ? `\u201c${now.text.join(", ")}\u201d is not a word that can be asked here.` : words(now.problem)) : "Looking\u2026";
      at("why").textContent = "";
    } else if (now.sets.length && !now.count) {
      at("answer").textContent = "Nothing is selected.";
      at("why").textContent = "Add to it with the brush or the box.";
    } else if (!lit(now) && answer.present === false) {
      at("answer").textContent = `${quoted(now)} is not here.`;
      at("why").textContent = reason(answer);
    } else if (!lit(now)) {
      at("answer").textContent = now.text.length ? `Nothing stands apart for ${quoted(now)}.` : "Nothing like it stands apart.";
      at("why").textContent = "Other words may help, or a click on an example.";
    } else {
      at("answer").textContent = now.count
        ? `${unsure(now) ? "Not sure: " : ""}${plural(now.count, "splat")} of ${count(now.scores.length)} (${percent(now.count / now.scores.length)}).`
        : "No splat scores that high.";
      at("why").textContent = decided(now);
    }
  }

  bars() {
    if (this.now?.answer) drawHistogram(at("histogram"), { ...this.now, cut: lit(this.now) ? this.now.cut : Infinity, auto: this.now.auto ?? null });
  }

  list() {
    const { now } = this;
    const things = now.things || [];
    at("stepping").hidden = !things.length || (now.sets.length === 1 && things.length === 1);
    at("which").textContent = this.thing < 0 ? plural(things.length, "thing") : `${this.thing + 1} of ${things.length}`;
    at("things").replaceChildren(...(now.sets.length ? [] : things).map((thing, place) => el("li", {},
      el("button", { type: "button", className: "thing", "aria-pressed": String(place === this.thing), on: { click: () => this.choose(now, place) } },
        el("b", {}, String(place + 1)), el("span", {}, plural(thing.splats, "splat"), el("small", {}, measures(thing.box))),
        el("span", { className: "score", title: "mean score" }, thing.score.toFixed(2))))));
    at("apart").textContent = now.nothings && !things.length ? now.nothings : "";
  }
}

// Questions of a link.
export function linkedQuestions(parameters) {
  const given = name => parameters.getAll(name);
  const terms = given("text").slice(0, MOST).map(text => ({ text: [text] }));
  if (given("like").length) terms.push({ like: given("like") });
  if (given("sets").length) terms.push({ sets: given("sets") });
  if (given("unlike").length && terms.length) terms.at(-1).unlike = given("unlike");
  return terms.map((one, place) => fresh({ ...read(parameters, place), ...one }, place));
}

// What the service is asked by a question of a lift.
function request(lift, question, negatives) {
  const cut = question.threshold !== "auto" && !question.answer?.present; // which holds all the same
  return { lift: lift.id, ...asked({ ...question, negatives: question.sets.length ? [] : negatives, ...(cut && { absent: "keep" }) }) };
}

// The answer to a question, its scores, what of them is shown, and where they are cut.
export async function answered(lift, question, negatives) {
  const path = (route, how, more = {}) => `${route}?${search({ ...request(lift, { ...question, ...how }, negatives), ...more })}`;
  const [answer, scores, selected] = await Promise.all([
    json(path("/query", {}, { top: 1 })),
    question.sets.length ? bytes(path("/query/selection")).then(content => Float32Array.from(npy(content)))
      : bytes(path("/query/scores", { threshold: "auto" })).then(npy),
    question.threshold === "auto" && !question.sets.length ? bytes(path("/query/selection")).then(npy) : null,
  ]);
  const { min = 0, max = 0 } = answer.statistics;
  const cut = answer.threshold.value ?? Infinity;
  return { answer, scores, shown: selected ? passing(scores, selected, cut) : scores, low: min, high: max, cut, count: answer.count, bins: histogram(scores, min, max) };
}

// What the painter takes of questions that have an answer, and of one whose scores are shown as heat.
export const painted = questions => questions.filter(question => question.answer && lit(question))
  .map(question => ({ question, scores: question.shown, cut: question.cut, high: question.high, rgb: rgb(question.colour) }));
export const heated = question => (question?.answer ? { scores: question.scores, low: question.low, high: question.high } : null);

const fresh = (terms, place) => ({ ...blank(), things: [], ...terms, colour: COLOURS[place % COLOURS.length] });
const split = text => text.split(",").map(word => word.trim()).filter(Boolean);
const lit = question => question.anyway || question.threshold !== "auto" || (question.answer.clear && question.answer.present !== false);
const shown = term => term.replace(/^splat:/, "splat ").replace(/^region:(.*):(\d+):(\d+)$/, "a mask of $1").replace(/^(.*):(box|stroke):[\d,\s]+$/, "a $2 of $1");
export const naming = new Map(); // what things and selections are called, by their terms
export const label = question => question.text.join(", ") || question.sets.map(one => (question.titles ?? naming).get(one) || one.replace(/^object:(\d+)$/, (_, number) => `thing ${Number(number) + 1}`).replace(/^selection:.*/, "a selection")).join(", ") || (question.like.length > 1 ? `like ${question.like.length} examples` : `like ${shown(question.like[0] || "")}`);
const quoted = question => (question.text.length ? `\u201c${question.text.join(", ")}\u201d` : "Such a thing");
const measures = ({ low, high }) => ` ${low.map((value, axis) => (high[axis] - value).toPrecision(2)).join(" \u00d7 ")}`;

const reason = answer => answer.reason.replace(/^(?:Whether )?(?:'.*?'|".*?") is not (?:there|sure): (.)/, (_, first) => first.toUpperCase())
  .replace(/^Whether (?:'.*?'|".*?") is there is not sure: (.)/, (_, first) => first.toUpperCase()).replace(/reference words?/g, "other words");

// It may be there, and other words compete for what was found.
const unsure = ({ text, answer }) => Boolean(text.length && answer && answer.present !== false
  && (!answer.clear || answer.rivals.length || (answer.present === null && answer.presence !== null)));
const spoken = word => word.replace(/\s*\(.*\).*$/, "") || word;
const button = (label, press, more = {}) => el("button", { type: "button", ...more, on: { click: press } }, label);
const line = (...parts) => el("p", {}, ...parts);

function advice(question, ask) {
  const { answer, problem, text } = question;
  const lines = (answer?.wording || []).map(one => line(`\u201c${one.text}\u201d was asked as `, el("b", {}, one.word), "."));
  if (problem?.nearest) {
    const near = problem.nearest.length ? problem.nearest : ask.sceneWords.slice(0, 5);
    lines.push(line(`\u201c${text.join(", ")}\u201d is not a word that can be asked here. `, near.length ? "Try " : "Try another word.",
      ...near.map(word => button(spoken(word), () => ask.word(word, question)))));
  }
  const rivals = (answer?.rivals || []).filter(word => !ask.negatives.includes(word));
  if (answer?.present === false && rivals.length) lines.push(line(`\u201c${text.join(", ")}\u201d is not here. Closest is `, ...rivals.map(word => button(spoken(word), () => ask.word(word, question)))));
  if (unsure(question) && rivals.length) {
    lines.push(line(`Not sure: ${rivals.length > 1 ? "these are" : "this is"} nearer. `, ...rivals.flatMap(word => [button(spoken(word), () => ask.word(word, question)), button(`but not ${spoken(word)}`, () => ask.butNot(word))])));
  } else if (unsure(question)) lines.push(line("Not sure: hardly anything stands apart for it."));
  return lines;
}

function decided({ answer, threshold, anyway, sets }) {
  if (sets.length) return "";
  if (answer.present === false) return `It is not here; this is what comes closest. ${reason(answer)}`;
  if (answer.present === null && answer.presence !== null) return reason(answer);
  if (!answer.clear && threshold === "auto" && anyway) return "This is what comes closest; it hardly stands apart from the rest.";
  if (typeof threshold === "number") return "You set this. The dashes mark what is chosen by itself.";
  const how = /least, in log-odds/.test(answer.threshold.explanation)
    ? "moving it a little changes least of what is found" : "no gap is clear, so it splits the scores into two groups";
  return `Chosen by itself: there, ${how}.`;
}
