// The panel of taking away: files of the question on the screen, and the lines that ask it elsewhere.
import { at, copied, el, notify } from "./dom.js";
import { label } from "./ask.js";
import { search } from "./question.js";
import { keyOf, save, saveBlob, words } from "./service.js";

const MOST = 16; // questions of a ZIP

export class Take {
  constructor({ ask, look, names, things, shot }) {
    Object.assign(this, { ask, look, names, things, shot });
    for (const button of document.querySelectorAll("[data-take]")) button.addEventListener("click", () => this.take(button.dataset.take));
    at("shot").addEventListener("click", async () => saveBlob(await this.shot(), "splatlift.png"));
    for (const [id, all] of [["take-everything", false], ["take-things", true]]) at(id).addEventListener("click", () => this.everything(all));
    at("copy-link").addEventListener("click", () => copied(location.href));
    for (const name of ["curl", "python"]) at(`copy-${name}`).addEventListener("click", () => copied(at(name).textContent));
  }

  address(what) {
    const question = this.ask.now;
    const view = this.look.view?.name;
    const path = { scores: "/query/scores", mask: "/query/mask", object: "/query/splats", coloured: "/query/splats", boxes: "/query/objects" }[what];
    const more = { mask: { view }, object: { what: "object" }, coloured: { what: "scores" } }[what] || {};
    return `${path}?${this.ask.parameters(question, more)}`;
  }

  // One ZIP of all that is asked or named, or of the things of the scene.
  async everything(things) {
    const { questions, lift } = this.ask;
    const named = this.names.shown ? { of: "words", ...this.names.asked } : { of: "questions", questions: questions.filter(({ answer }) => answer).map(one => ({ ...this.ask.body(one), name: label(one).slice(0, 100) })) };
    const own = this.things.shown();
    if (own.length > MOST && this.things.own.length) notify(`A ZIP has ${MOST} things of your own list: the first ones are in it.`);
    const space = lift.text_space === "none" ? {} : { encoder: lift.text_space };
    const body = { lift: lift.id, ...(things && this.things.own.length ? { of: "questions", questions: own.slice(0, MOST).map(one => ({ lift: lift.id, ...one, name: one.name.slice(0, 100) })) } : things ? { of: "objects", ...space } : named) };
    if (own.length <= MOST || !things) notify("Making the ZIP: masks of all views take a while.");
    try {
      await save("/query/export", "splats.zip", body).catch(problem => (problem.argument === "encoder" ? save("/query/export", "splats.zip", { lift: lift.id, of: "objects" }) : Promise.reject(problem)));
      notify("The ZIP is here.");
    } catch (problem) {
      notify(words(problem), true);
    }
  }

  async take(what) {
    const view = this.look.view?.name;
    const [path, body, own] = {
      labels: ["/query/segment/labels", this.named(), "words.npy"], map: ["/query/segment/map", this.named(view), `words-${view}.png`],
      legend: ["/query/segment/picture", this.named(view), `legend-${view}.png`],
    }[what] || [];
    const word = this.ask.now ? label(this.ask.now) : "scene";
    const name = own || { scores: `${word}-scores.npy`, mask: `${word}-${this.look.view?.name}.png`, object: `${word}.ply`, coloured: `${word}-scores.ply`, boxes: `${word}-boxes.json` }[what];
    try {
      await save(path || this.address(what), name.replaceAll(/[/\\:*?"<>|]/g, "-"), body, true);
    } catch (problem) {
      notify(words(problem), true);
    }
  }

  // What names everything, as the service takes it.
  named(view) {
    return { lift: this.ask.lift.id, ...this.names.asked, ...(view ? { view } : {}) };
  }

  show() {
    const { now, lift } = this.ask;
    const named = Boolean(lift && this.names.shown);
    const ready = named || Boolean(now?.answer && lift);
    at("lift-file").replaceChildren(lift ? el("button", { type: "button", on: { click: () => save(`/lifts/${lift.id}/features`).catch(problem => notify(words(problem), true)) } },
      `Lift file (${(lift.bytes / 1e6).toFixed(1)} MB)`) : "");
    at("take-none").hidden = ready;
    at("take-question").hidden = !ready;
    at("take-answer").hidden = named;
    at("take-everything").hidden = !ready;
    at("take-things").hidden = !lift?.links.objects;
    at("take-names").hidden = !named;
    if (!ready) return;
    const key = keyOf() ? ' -H "Authorization: Bearer $KEY"' : "";
    if (named) {
      at("curl").textContent = `curl -fsS${key} ${address("segment")} \\\n  --json ${quote(JSON.stringify(this.named()))}`;
      at("python").textContent = posted("segment", JSON.stringify(this.named(), null, 1), ['for word in answer["named_words"]:', '    print(word["value"], word["word"], word["splats"])']);
      return;
    }
    const asked = this.ask.body(now);
    const terms = [...search(asked)].map(([name, value]) => ` \\\n  --data-urlencode ${quote(`${name}=${value}`)}`).join("");
    at("curl").textContent = `curl -fsSG${key} ${address()}${terms}`;
    at("python").textContent = local(now) ? ofFile(asked, now.answer.encoder)
      : posted("", JSON.stringify(asked, null, 1), ['print(answer["count"], answer["reason"], answer["threshold"])']);
  }
}

// Encoders that open on any machine by their name alone; `prompts` are the lift's own words.
const local = ({ text, like, unlike, answer }) => text.length && !like.length && !unlike.length && ["lvis", "minilm", "prompts"].includes(answer.encoder);
const address = what => new URL(what ? `query/${what}` : "query", document.baseURI); // also behind a proxy's prefix

// The question in Python, of the lift file.
function ofFile({ lift, ...asked }, encoder) {
  const query = `lc.Query(${Object.entries(asked).map(([name, value]) => `${name}=${JSON.stringify(value)}`).join(", ")})`;
  const more = encoder === "prompts" ? "" : `, encoder="${encoder}"`;
  return ["import liftcore as lc", "", `scene = lc.Scene("lift-${lift}.safetensors")`, `answer = scene.ask(${query}${more})`,
    "print(answer.count, answer.reason, answer.threshold.explanation)"].join("\n");
}

// A question of the service in Python, from its body and what is printed of the answer.
function posted(what, body, printed) {
  const key = keyOf();
  return [...(key ? ["import os", ""] : []), "import httpx", "", `question = ${body}`,
    ...(key ? [`headers = {"Authorization": f"Bearer {os.environ['KEY']}"}`] : []),
    `answer = httpx.post("${address(what)}", json=question${key ? ", headers=headers" : ""}, timeout=600).raise_for_status().json()`, ...printed].join("\n");
}

const quote = text => (/^[\w=.:,-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
