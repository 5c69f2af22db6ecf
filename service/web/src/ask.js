// The panel of asking: words and examples, each a question with a colour; what they found, and where to cut.
import { at, count, el, percent, plural, tell } from "./dom.js";
import { countFrom, drawHistogram, histogram, passing } from "./histogram.js";
import { COLOURS, rgb } from "./painter.js";
import { asked, blank, linked, notation, read, search } from "./question.js";
import { bytes, json, npy, words } from "./service.js";

const MOST = COLOURS.length; // questions at a time
const SOON = 350; // ms after the slider's last move, until the things are looked for anew

export class Ask {
  // changed: called when colours, boxes or the link must follow; fly: with a box to look at.
  constructor({ changed, fly }) {
    Object.assign(this, { changed, fly, questions: [], active: 0, thing: -1, negatives: [], heat: false, turn: 0, lift: null });
    at("query").addEventListener("submit", event => { event.preventDefault(); this.fromForm(); });
    Object.assign(at("example"), { maxLength: notation.maxLength, placeholder: notation.description, title: notation.description });
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
    const wordless = Boolean(lift) && lift.text_space === "none";
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

  fromForm() {
    const texts = split(at("words").value);
    if (!texts.length) return this.questions.length ? this.ask() : undefined;
    if (texts.length > MOST) tell(`Only the first ${MOST} are asked at a time.`);
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
      if (less) return tell("First say what you look for; then shift-click what it is not.");
      this.questions = [fresh({ like: [notation] }, 0)];
      this.active = 0;
      at("words").value = "";
    }
    this.now.threshold = "auto";
    return this.ask(this.now);
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
    const given = name => parameters.getAll(name);
    const terms = given("text").slice(0, MOST).map(text => ({ text: [text] }));
    at("words").value = given("text").join(", ");
    at("but").value = given("negatives").join(", ");
    if (given("like").length) terms.push({ like: given("like") });
    if (!terms.length) return undefined;
    terms.at(-1).unlike = given("unlike");
    this.questions = terms.map((one, place) => fresh({ ...read(parameters, place), ...one }, place));
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
    const cut = question.threshold !== "auto" && !question.answer?.present; // which holds all the same
    return { lift: this.lift.id, ...asked({ ...question, negatives: this.negatives, ...(cut && { absent: "keep" }) }) };
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
    if (wrong) tell(words(wrong.problem), true);
    await Promise.all(anew.map(question => this.things(question)));
  }

  async answer(question, mine) {
    try {
      const automatic = { ...question, threshold: "auto" };
      const [answer, scores, selected] = await Promise.all([
        json(`/query?${this.parameters(question, { top: 1 })}`),
        bytes(`/query/scores?${this.parameters(automatic)}`).then(npy),
        question.threshold === "auto" ? bytes(`/query/selection?${this.parameters(question)}`).then(npy) : null,
      ]);
      if (mine !== this.turn) return;
      const { min = 0, max = 0 } = answer.statistics;
      const cut = answer.threshold.value ?? Infinity;
      const shown = selected ? passing(scores, selected, cut) : scores;
      Object.assign(question, { answer, scores, shown, low: min, high: max, cut, count: answer.count, bins: histogram(scores, min, max) });
      if (question.threshold === "auto") question.auto = answer.threshold.value;
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
        question.nothings = problem.expected ? `Things are not told apart here: ${problem.expected}.` : words(problem);
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
    return this.questions.filter(question => question.answer && lit(question))
      .map(question => ({ question, scores: question.shown, cut: question.cut, high: question.high, rgb: rgb(question.colour) }));
  }

  heated() {
    const question = this.now;
    return this.heat && question?.answer ? { scores: question.scores, low: question.low, high: question.high } : null;
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
    if (!this.now) return;
    const { now } = this;
    at("found").style.setProperty("--mine", now.colour);
    at("title").textContent = label(now);
    at("scale").hidden = !now.answer;
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
    this.told();
    this.bars();
    this.list();
  }

  chip(question, place) {
    const numbers = question.answer ? (lit(question) ? count(question.count) : question.answer.present === false ? "not here" : "unclear") : question.problem ? "!" : "\u2026";
    return el("li", { className: question === this.now ? "chip now" : "chip", style: { "--mine": question.colour } },
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

  // What was found and what decided it, in words.
  told() {
    const { now } = this;
    const answer = now.answer;
    at("slider-value").textContent = answer && Number.isFinite(now.cut) ? now.cut.toFixed(3) : "";
    at("auto").disabled = !answer || now.threshold === "auto";
    at("nearest").hidden = !answer || lit(now);
    if (!answer) {
      at("answer").textContent = now.problem ? words(now.problem) : "Looking\u2026";
      at("why").textContent = "";
    } else if (!lit(now) && answer.present === false) {
      at("answer").textContent = `${quoted(now)} is not here.`;
      at("why").textContent = reason(answer);
    } else if (!lit(now)) {
      at("answer").textContent = now.text.length ? `Nothing stands apart for ${quoted(now)}.` : "Nothing like it stands apart.";
      at("why").textContent = "Other words may help, or a click on an example.";
    } else {
      at("answer").textContent = now.count
        ? `${plural(now.count, "splat")} of ${count(now.scores.length)} (${percent(now.count / now.scores.length)}).`
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
    at("stepping").hidden = !things.length;
    at("which").textContent = this.thing < 0 ? plural(things.length, "thing") : `${this.thing + 1} of ${things.length}`;
    at("things").replaceChildren(...things.map((thing, place) => el("li", {},
      el("button", { type: "button", className: "thing", "aria-pressed": String(place === this.thing), on: { click: () => this.choose(now, place) } },
        el("b", {}, String(place + 1)), el("span", {}, plural(thing.splats, "splat"), el("small", {}, measures(thing.box))),
        el("span", { className: "score", title: "mean score" }, thing.score.toFixed(2))))));
    at("apart").textContent = now.nothings && !things.length ? now.nothings : "";
  }
}

const fresh = (terms, place) => ({ ...blank(), things: [], ...terms, colour: COLOURS[place % COLOURS.length] });
const split = text => text.split(",").map(word => word.trim()).filter(Boolean);
const lit = question => question.anyway || question.threshold !== "auto" || (question.answer.clear && question.answer.present !== false);
const shown = term => term.replace(/^splat:/, "splat ").replace(/^region:(.*):(\d+):(\d+)$/, "a mask of $1").replace(/^(.*):(box|stroke):[\d,\s]+$/, "a $2 of $1");
export const label = question => question.text.join(", ") || (question.like.length > 1 ? `like ${question.like.length} examples` : `like ${shown(question.like[0] || "")}`);
const quoted = question => (question.text.length ? `\u201c${question.text.join(", ")}\u201d` : "Such a thing");
const measures = ({ low, high }) => ` ${low.map((value, axis) => (high[axis] - value).toPrecision(2)).join(" \u00d7 ")}`;

const reason = ({ why }) => why.replace(/^(?:'.*?'|".*?") is not there: (.)/, (_, first) => first.toUpperCase());

function decided({ answer, threshold, anyway }) {
  if (answer.present === false) return `It is not here; this is what comes closest. ${reason(answer)}`;
  if (!answer.clear && threshold === "auto" && anyway) return "This is what comes closest; it hardly stands apart from the rest.";
  if (typeof threshold === "number") return "You set this cut. The dashes mark the automatic one.";
  const how = /least, in log-odds/.test(answer.threshold.explanation)
    ? "moving it a little changes least of what is found" : "no gap is clear, so it splits the scores into two groups";
  return `The cut was found by itself: there, ${how}.`;
}
