// Two sides with one camera: what was on the screen stays on the left, while the right goes on to another word, another
// cut or another scene.
import { answered, heated, label, linkedQuestions, painted } from "./ask.js";
import { at, count, el, notify } from "./dom.js";
import { title } from "./lifts.js";
import { inColours, linkedWords, namedSplats } from "./names.js";
import { bytes, json, npy, words } from "./service.js";
import { titlesOf } from "./things.js";

const HINT = "Now ask another word, move the slider or choose another scene: the left stays.";
const SCREEN = ["beside", "camera", "show", "view"]; // of the right alone

export class Beside {
  // viewer: gives the 3D view of the right; made: another one, on a canvas; now: gives the link of the right; changed: after
  // a side came or went.
  constructor({ viewer, made, now, changed }) {
    Object.assign(this, { viewer, made, now, changed, link: null, turn: 0 });
    for (const button of document.querySelectorAll("[data-compare]")) button.addEventListener("click", () => (this.link ? this.end() : this.hold(this.now())));
    at("end-compare").addEventListener("click", () => this.end());
  }

  // Show on the left what a link opens.
  async hold(link) {
    const mine = ++this.turn;
    this.link = new URLSearchParams([...new URLSearchParams(link)].filter(([name]) => !SCREEN.includes(name)));
    this.scene = null;
    this.show();
    this.changed();
    at("beside-said").replaceChildren("Loading the left side\u2026");
    try {
      const side = await this.side(this.link);
      if (mine !== this.turn) return;
      this.left ||= this.made(at("beside"));
      const { viewer, left } = this;
      left.origin = side.lift.origin;
      if (this.loaded !== side.lift.id) await left.load(side.content);
      if (mine !== this.turn) return;
      this.loaded = side.lift.id;
      viewer().pair(left);
      left.paint(painted(side.questions), { heat: side.heat, layer: side.layer, hide: this.link.has("hide") });
      this.scene = side.lift;
      at("beside-said").replaceChildren(...summary(side.questions, side.lift, side.also));
    } catch (problem) {
      if (mine !== this.turn) return;
      notify(words(problem), true);
      this.end();
    }
  }

  async side(link) {
    const lift = await json(`/lifts/${link.get("lift")}`);
    const questions = linkedQuestions(link);
    const [content, layer] = await Promise.all([this.loaded === lift.id ? null : bytes(`/lifts/${lift.id}/splats`), layerOf(lift, link),
      ...questions.map(async question => { if (question.sets.length) question.titles = await titlesOf(lift, question.sets); }),
      ...questions.map(async question => Object.assign(question, await answered(lift, question, link.getAll("negatives"))))]);
    return { lift, questions, content, layer, heat: link.has("heat") ? heated(questions[0]) : null, also: layer?.name };
  }

  end() {
    this.turn += 1;
    this.link = null;
    this.left?.clear();
    this.loaded = null;
    this.show();
    this.changed();
  }

  // A link's own left side.
  restore(parameters) {
    if (parameters.has("beside")) return String(this.link) === parameters.get("beside") ? undefined : this.hold(parameters.get("beside"));
    return this.link ? this.end() : undefined;
  }

  // What of the right is asked of another scene, too: words alone hold there, and the camera where the frame is the same.
  carried(lift) {
    if (!this.link) return null;
    const now = new URLSearchParams(this.now());
    const same = this.scene && (this.scene.cameras === lift.cameras || this.scene.splats === lift.splats);
    const kept = ["text", "negatives", "named", "only", "table", "what", "heat", "hide", "beside", ...(same ? ["camera", "view"] : [])];
    return new URLSearchParams([["lift", lift.id], ...[...now].filter(([name]) => kept.includes(name))]);
  }

  show() {
    at("stage").classList.toggle("comparing", Boolean(this.link));
    for (const button of document.querySelectorAll("[data-compare]")) {
      button.textContent = this.link ? "End the comparison" : "Compare";
      button.setAttribute("aria-pressed", String(Boolean(this.link)));
    }
  }

  // What the right shows.
  follow(questions, lift) {
    if (!this.link || !lift) return;
    const now = new URLSearchParams([...new URLSearchParams(this.now())].filter(([name]) => !SCREEN.includes(name)));
    at("right-said").replaceChildren(...(String(now) === String(this.link) ? [el("span", {}, HINT)] : summary(questions, lift)));
  }
}

// The questions of a side with their colours, and its scene.
function summary(questions, lift, also) {
  const asked = questions.map(question => el("span", { className: "asked", style: { "--mine": question.colour } }, el("span", { className: "swatch", "aria-hidden": "true" }),
    label(question), el("small", {}, question.answer ? ` ${count(question.count)}${Number.isFinite(question.cut) && !question.sets.length ? ` from ${question.cut.toFixed(3)}` : ""}` : "")));
  return [...asked, also && el("span", {}, also), el("small", {}, title(lift))].filter(Boolean);
}

// The colours of a link that is no question's.
async function layerOf(lift, link) {
  if (link.has("named")) {
    const [found, values] = await namedSplats(lift, linkedWords(link));
    const only = link.getAll("only");
    const looked = value => !only.length || found.named_words.some(one => one.value === value && only.includes(one.word));
    return { ...inColours(found, values, looked), name: "everything named" };
  }
  const what = link.get("what");
  const chosen = [...document.querySelectorAll("input[name=layer]")].find(({ value }) => value === what); // a link may name anything
  if (!chosen || ["rgb", "depth", "photo"].includes(what)) return null;
  return { colours: npy(await bytes(`/lifts/${lift.id}/colours?what=${what}`)), cover: 1, name: chosen.nextSibling.textContent };
}
