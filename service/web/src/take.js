// The panel of taking away: files of the question on the screen, and the lines that ask it elsewhere.
import { at, el, tell } from "./dom.js";
import { keyOf, save, saveBlob, words } from "./service.js";

export class Take {
  constructor({ ask, look, shot }) {
    Object.assign(this, { ask, look, shot });
    for (const button of document.querySelectorAll("[data-take]")) button.addEventListener("click", () => this.take(button.dataset.take));
    at("shot").addEventListener("click", async () => saveBlob(await this.shot(), "splatlift.png"));
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

  async take(what) {
    const name = { scores: "scores.npy", mask: `mask-${this.look.view?.name}.png`, object: "object.ply", coloured: "scene.ply", boxes: "boxes.json" }[what];
    try {
      await save(this.address(what), name.replaceAll("/", "-"));
    } catch (problem) {
      tell(words(problem), true);
    }
  }

  show() {
    const { now, lift } = this.ask;
    const ready = Boolean(now?.answer && lift);
    at("take-none").hidden = ready;
    at("take-question").hidden = !ready;
    if (!ready) return;
    const key = keyOf() ? ' -H "Authorization: Bearer $KEY"' : "";
    const asked = [...this.ask.parameters(now)].map(([name, value]) => ` \\\n  --data-urlencode ${quote(`${name}=${value}`)}`).join("");
    at("curl").textContent = `curl -fsSG${key} ${location.origin}/query${asked}`;
    const terms = [...now.text, ...now.like].map(term => JSON.stringify(term)).join(", ");
    const cut = now.threshold === "auto" ? "" : `, threshold=${now.threshold}`;
    at("python").textContent = now.text.length && !now.like.length && !now.unlike.length && lift.text_space === "minilm"
      ? ["import liftcore as lc", "from liftcore.query.text import open_encoder", "",
        `lift = lc.load_lift("lift-${lift.id}.safetensors")`, `words = open_encoder("minilm").encode([${terms}])`,
        `found = lift.query(words${cut})`, "print(found.splats.sum(), found.explanation)"].join("\n")
      : ["import httpx", "", `asked = ${JSON.stringify(Object.fromEntries(["text", "like", "unlike"].map(name => [name, now[name]])))}`,
        `asked |= {"lift": "${lift.id}", "threshold": ${JSON.stringify(now.threshold)}}`,
        `found = httpx.post("${location.origin}/query", json=asked).json()`, 'print(found["count"], found["threshold"])'].join("\n");
    at("lift-file").replaceChildren(el("button", { type: "button", on: { click: () => save(`/lifts/${lift.id}/features`).catch(problem => tell(words(problem), true)) } },
      `Lift file (${(lift.bytes / 1e6).toFixed(1)} MB)`));
  }
}

async function copied(text) {
  try {
    await navigator.clipboard.writeText(text);
    tell("Copied.");
  } catch {
    tell("This browser does not let the page copy: mark the text and copy it by hand.", true);
  }
}

const quote = text => (/^[\w=.:,-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
