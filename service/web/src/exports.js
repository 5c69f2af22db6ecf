// The panel Export: files of the current question or labels, and the same query for curl and Python.
import { byId, copyText, el, notify, plural } from "./dom.js";
import { questionLabel } from "./query.js";
import { queryString } from "./question.js";
import { storedKey, download, problemText } from "./service.js";

const MAX_EXPORTS = 16; // questions of a file

export class ExportPanel {
  constructor({ query, layers, labels, objects }) {
    Object.assign(this, { query, layers, labels, objects });
    for (const button of document.querySelectorAll("[data-take]")) button.addEventListener("click", () => this.saveFile(button.dataset.take));
    for (const [id, ofObjects] of [["take-everything", false], ["take-objects", true]]) byId(id).addEventListener("click", () => this.saveLabels(ofObjects));
    byId("copy-link").addEventListener("click", () => copyText(location.href));
    for (const name of ["curl", "python"]) byId(`copy-${name}`).addEventListener("click", () => copyText(byId(name).textContent));
  }

  address(kind) {
    const question = this.query.current;
    const view = this.layers.view?.name;
    const options = kind === "mask" ? { view } : {};
    return `/query/${kind}?${this.query.requestParameters(question, options)}`;
  }

  // Save a file with all questions or labels; with ofObjects, with the objects of the scene.
  async saveLabels(ofObjects) {
    const format = byId("take-format").value;
    const { questions, lift } = this.query;
    const labelBody = this.labels.isShown ? { of: "words", ...this.labels.vocabulary } : { of: "questions", questions: questions.filter(({ answer }) => answer).map(item => ({ ...this.query.requestBody(item), name: questionLabel(item).slice(0, 100) })) };
    const listedObjects = this.objects.exportedSets();
    if (listedObjects.length > MAX_EXPORTS && this.objects.selections.length) notify(`A file has at most ${MAX_EXPORTS} objects of an edited list: it has the first ${MAX_EXPORTS}.`);
    const encoder = lift.text_space === "none" ? {} : { encoder: lift.text_space };
    const body = { lift: lift.id, format, ...(ofObjects && this.objects.selections.length ? { of: "questions", questions: listedObjects.slice(0, MAX_EXPORTS).map(item => ({ lift: lift.id, ...item, name: item.name.slice(0, 100) })) } : ofObjects ? { of: "objects", ...encoder } : labelBody) };
    try {
      await download("/query/export", "labels", body).catch(problem => (problem.argument === "encoder" ? download("/query/export", "labels", { lift: lift.id, format, of: "objects" }) : Promise.reject(problem)));
      const hidden = this.objects.items.filter(object => object.hidden).length;
      const rest = !ofObjects ? "" : body.of === "questions" ? ` Selections have the splats that they share with objects. Left out: the background${hidden ? ` and ${plural(hidden, "hidden object")}` : ""}.` : hidden ? ` ${plural(hidden, "hidden object")} included.` : "";
      notify(`The file is saved.${rest}`);
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }

  async saveFile(kind) {
    const view = this.layers.view?.name;
    const [path, body, fileName] = {
      labels: ["/query/segment/labels", this.labelBody(), "words.npy"], map: ["/query/segment/map", this.labelBody(view), `words-${view}.png`],
      picture: ["/query/segment/picture", this.labelBody(view), `legend-${view}.png`],
    }[kind] || [];
    const title = this.query.current ? questionLabel(this.query.current) : "scene";
    const name = fileName || { scores: `${title}-scores.npy`, mask: `${title}-${this.layers.view?.name}.png`, object: `${title}.ply`, objects: `${title}-boxes.json` }[kind];
    try {
      await download(path || this.address(kind), name.replaceAll(/[/\\:*?"<>|]/g, "-"), body, true);
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }

  // The body of a request for labels, with a view or without.
  labelBody(view) {
    return { lift: this.query.lift.id, ...this.labels.vocabulary, ...(view ? { view } : {}) };
  }

  render() {
    const { current: question, lift } = this.query;
    const isLabelled = Boolean(lift && this.labels.isShown);
    const isReady = isLabelled || Boolean(question?.answer && lift);
    byId("lift-file").replaceChildren(lift ? el("button", { type: "button", on: { click: () => download(`/lifts/${lift.id}/features`).catch(problem => notify(problemText(problem), true)) } },
      `Lift file (${(lift.bytes / 1e6).toFixed(1)} MB)`) : "");
    byId("take-none").hidden = isReady;
    byId("take-question").hidden = !isReady;
    byId("take-answer").hidden = isLabelled;
    byId("take-everything").hidden = !isReady;
    byId("take-objects").hidden = !lift?.links.objects;
    byId("take-names").hidden = !isLabelled;
    if (!isReady) return;
    const key = storedKey() ? ' -H "Authorization: Bearer $KEY"' : "";
    if (isLabelled) {
      byId("curl").textContent = `curl -fsS${key} ${address("segment")} \\\n  --json ${shellQuote(JSON.stringify(this.labelBody()))}`;
      byId("python").textContent = httpSnippet("segment", JSON.stringify(this.labelBody(), null, 1), ['for word in answer["named_words"]:', '    print(word["value"], word["word"], word["splats"])']);
      return;
    }
    const body = this.query.requestBody(question);
    const terms = [...queryString(body)].map(([name, value]) => ` \\\n  --data-urlencode ${shellQuote(`${name}=${value}`)}`).join("");
    byId("curl").textContent = `curl -fsSG${key} ${address()}${terms}`;
    byId("python").textContent = httpSnippet("", JSON.stringify(body, null, 1), ['print(answer["count"], answer["reason"], answer["threshold"])']);
  }
}

const address = kind => new URL(kind ? `query/${kind}` : "query", document.baseURI); // also behind a proxy's prefix

// Python code for a request to the service: its kind, its body as JSON, and lines that print the answer.
function httpSnippet(kind, body, printLines) {
  const key = storedKey();
  return [...(key ? ["import os", ""] : []), "import httpx", "", `question = ${body}`,
    ...(key ? [`headers = {"Authorization": f"Bearer {os.environ['KEY']}"}`] : []),
    `answer = httpx.post("${address(kind)}", json=question${key ? ", headers=headers" : ""}, timeout=600).raise_for_status().json()`, ...printLines].join("\n");
}

const shellQuote = text => (/^[\w=.:,-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
