// The panel of looking: layers of colours in 3D and in the pictures of views, the list of views, and the pictures
// themselves, which need no WebGL.
import { at, el, fill, notify } from "./dom.js";
import { edge } from "./masks.js";
import { bytes, json, npy, picture, words } from "./service.js";

const PAGE = 1000; // views that are asked for at a time
const LAYERS = {
  rgb: "The splats' own colours.",
  pca: "Three principal components of the features as red, green and blue: what looks alike here is alike to a question.",
  cluster: "A colour for each cluster that aggregation found; grey is in none.",
  evidence: "How much the views say of each splat, by its logarithm: bright is much.",
  agreement: "How well the views agree on each splat: bright is well.",
  confidence: "How surely each splat's feature is right, by what other views say of the same regions: bright is surely.",
  photo: "The photo of the view, where one was brought.",
  depth: "The depth of the splats: near is bright.",
};
const ENDS = { evidence: ["little", "much"], agreement: ["not", "well"], confidence: ["not surely", "surely"], depth: ["far", "near"] }; // of the scale
const MODES = ["scene", "both", "view"];
const SHIFTED = 5; // pixels that the pointer may move in a click
const IN_VIEWS = ["rgb", "pca", "cluster", "confidence", "depth"]; // that the service draws of a view

export class Look {
  // changed: when colours or the link must follow; fly: with a view; pick: with an example's notation;
  // hit: with that of a click, which may mean a thing.
  constructor({ changed, fly, pick, hit, fallback }) {
    Object.assign(this, { changed, fly, pick, hit, views: [], view: null, colours: new Map(), layer: null, turn: 0, mode: fallback ? "view" : "scene" });
    this.fallback = fallback;
    for (const input of document.querySelectorAll("input[name=layer]")) input.addEventListener("change", () => this.choose(input.value));
    for (const input of document.querySelectorAll("input[name=mode]")) input.addEventListener("change", () => this.switch(input.value));
    at("cover").addEventListener("input", () => { this.blend(); this.changed(); });
    at("veil").addEventListener("input", () => this.blend());
    at("view").addEventListener("change", () => this.go(at("view").value));
    at("view-before").addEventListener("click", () => this.step(-1));
    at("view-after").addEventListener("click", () => this.step(1));
    at("picture").addEventListener("pointerdown", event => this.pressed(event));
    at("picture").addEventListener("pointermove", event => this.dragged(event));
    at("picture").addEventListener("click", event => this.clicked(event));
    at("picture").addEventListener("dragstart", event => event.preventDefault()); // of the picture itself
  }

  get what() {
    return document.querySelector("input[name=layer]:checked").value;
  }

  get title() {
    return document.querySelector("input[name=layer]:checked + span").textContent;
  }

  // The views of a lift; the first page is awaited, the others come after it.
  async of(lift, wanted) {
    this.lift = lift;
    this.colours.clear();
    this.layer = null;
    this.views = [];
    this.showLayer("rgb");
    const clusters = lift.diagnostics?.clusters ?? lift.settings?.aggregation;
    at("layer-cluster").hidden = !clusters;
    at("layer-confidence").hidden = !lift.settings?.robust_steps;
    at("layer-photo").hidden = !lift.photos;
    let { views, next } = await json(`/lifts/${lift.id}/views?limit=${PAGE}`);
    this.views = views;
    this.choices(wanted);
    if (next !== null) this.rest(lift, next);
  }

  async rest(lift, next) {
    try {
      while (next !== null) {
        const page = await json(`/lifts/${lift.id}/views?limit=${PAGE}&cursor=${next}`);
        if (lift !== this.lift) return;
        this.views.push(...page.views);
        next = page.next;
      }
      this.choices(this.view?.name);
    } catch (problem) {
      notify(words(problem), true);
    }
  }

  choices(wanted) {
    fill(at("view"), this.views.map(({ name, lifted }) => [name, lifted ? name : `${name} (not lifted)`]), wanted);
    this.view = this.views.find(view => view.name === at("view").value) || this.views[0] || null;
  }

  step(by) {
    if (!this.views.length) return;
    const place = this.views.indexOf(this.view);
    this.go(this.views[(place + by + this.views.length) % this.views.length].name);
  }

  go(name) {
    const view = this.views.find(known => known.name === name);
    if (!view) return;
    this.view = view;
    at("view").value = name;
    this.fly(view);
    this.draw();
    this.changed();
  }

  switch(mode) {
    this.mode = this.fallback ? "view" : MODES.includes(mode) ? mode : "scene"; // a link may name anything
    if (this.mode === "scene" && ["depth", "photo"].includes(this.what)) this.choose("rgb"); // of views alone
    at("stage").dataset.mode = this.mode;
    document.querySelector(`input[name=mode][value=${this.mode}]`).checked = true;
    this.draw();
    this.changed();
  }

  showLayer(what) {
    document.querySelector(`input[name=layer][value=${what}]`).checked = true;
    at("layer-words").textContent = LAYERS[what];
    at("cover-label").hidden = what === "rgb";
    at("layer-scale").hidden = !Object.hasOwn(ENDS, what);
    if (Object.hasOwn(ENDS, what)) at("layer-scale").querySelectorAll("span").forEach((end, place) => { end.textContent = ENDS[what][place]; });
  }

  async choose(what) {
    if (!Object.hasOwn(LAYERS, what)) return undefined;
    this.showLayer(what);
    this.draw();
    if (["rgb", "depth", "photo"].includes(what) || this.fallback) {
      this.layer = null;
      return this.changed();
    }
    try {
      const { lift } = this;
      if (!this.colours.has(what)) this.colours.set(what, npy(await bytes(`/lifts/${lift.id}/colours?what=${what}`)));
      if (lift !== this.lift || what !== this.what) return;
      this.layer = this.colours.get(what);
      this.changed();
    } catch (problem) {
      notify(words(problem), true);
      this.choose("rgb");
    }
  }

  painted() {
    return this.layer ? { colours: this.layer, cover: Number(at("cover").value) / 100 } : null;
  }

  // The view's picture, its layer over it, and a veil over what a question did not find.
  async draw() {
    const mine = ++this.turn;
    if (!this.lift || !this.view || this.mode === "scene") return;
    const shown = async (id, path) => {
      const image = at(id);
      const old = image.src;
      const made = path && await picture(path);
      if (mine !== this.turn) return made && URL.revokeObjectURL(made.src);
      if (old.startsWith("blob:")) URL.revokeObjectURL(old);
      if (made) image.src = made.src; else image.removeAttribute("src");
      image.hidden = !made;
    };
    const place = new URLSearchParams({ lift: this.lift.id, view: this.view.name });
    const over = this.what === "photo" ? this.view.photo && `/lifts/${this.lift.id}/photo?view=${encodeURIComponent(this.view.name)}`
      : IN_VIEWS.includes(this.what) && this.what !== "rgb" ? `/render?${place}&channel=${this.what}` : null;
    at("layer-words").textContent = this.what === "photo" && !this.view.photo ? "There is no photo of this view."
      : this.mode === "view" && ![...IN_VIEWS, "photo"].includes(this.what) ? `${LAYERS[this.what]} It is seen in 3D alone.` : LAYERS[this.what];
    at("picture-box").classList.add("busy");
    try {
      const examples = this.examples?.() || [];
      await Promise.all([shown("render", `/render?${place}&channel=rgb`), shown("over", over), this.mask(mine), this.masks?.outline(this.view.name, examples)]);
      this.marks();
    } catch (problem) {
      if (mine === this.turn) notify(words(problem), true);
    }
    if (mine === this.turn) at("picture-box").classList.remove("busy");
    this.blend();
  }

  async mask(mine) {
    const canvas = at("mask");
    const asked = this.asked?.(this.view.name);
    if (!asked) { canvas.hidden = true; return; }
    const image = await picture(asked.path, asked.body);
    URL.revokeObjectURL(image.src);
    if (mine !== this.turn) return;
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    context.putImageData(asked.paint(context.getImageData(0, 0, canvas.width, canvas.height)), 0, 0);
    canvas.hidden = false;
    canvas.dataset.view = this.view.name;
  }

  blend() {
    at("over").style.opacity = Number(at("cover").value) / 100;
    at("mask").style.opacity = Number(at("veil").value) / 100;
  }

  // Where examples of this view were clicked.
  marks() {
    for (const old of at("picture").querySelectorAll(".mark")) old.remove();
    for (const { term, unlike } of this.examples?.() || []) {
      const [, view, kind, listed] = AREA.exec(term) || [];
      if (view !== this.view.name) continue;
      const numbers = listed.split(",").map(Number);
      if (kind === "box") this.mark(numbers, unlike);
      else for (let place = 0; place < numbers.length; place += 2) this.mark(numbers.slice(place, place + 2), unlike);
    }
  }

  mark([x0, y0, x1, y1], unlike) {
    const className = `mark${unlike ? " unlike" : ""}${x1 === undefined ? "" : " box"}`;
    at("picture").append(el("span", { className, style: this.placed(x1 === undefined ? [x0 + 0.5, y0 + 0.5] : [x0, y0, x1, y1]) }));
  }

  // Pixels of the view as shares of its picture.
  placed([x0, y0, x1, y1]) {
    const { width, height } = this.view;
    const sides = x1 === undefined ? {} : { width: `${100 * (x1 - x0) / width}%`, height: `${100 * (y1 - y0) / height}%` };
    return { left: `${100 * x0 / width}%`, top: `${100 * y0 / height}%`, ...sides };
  }

  // The pixel under the pointer, or the nearest one at the rim; null without a picture.
  pixel({ clientX, clientY }) {
    const { naturalWidth: width, naturalHeight: height } = at("render");
    const box = at("render").getBoundingClientRect();
    if (!width || !box.width) return null;
    const within = (share, side) => Math.max(0, Math.min(side - 1, Math.floor(share * side)));
    return [within((clientX - box.left) / box.width, width), within((clientY - box.top) / box.height, height)];
  }

  // A mouse or a pen draws a box; a finger moves the page.
  pressed(event) {
    this.from = event.button === 0 && event.pointerType !== "touch" ? { pixel: this.pixel(event), x: event.clientX, y: event.clientY } : null;
    this.box = null;
    at("drawn").hidden = true;
    if (this.from?.pixel) at("picture").setPointerCapture(event.pointerId);
  }

  dragged(event) {
    const { from } = this;
    if (!from?.pixel || !event.buttons || (!this.box && Math.hypot(event.clientX - from.x, event.clientY - from.y) <= SHIFTED)) return;
    const [across, down] = [0, 1].map(axis => [from.pixel[axis], this.pixel(event)[axis]].sort((one, other) => one - other));
    this.box = [across[0], down[0], across[1] + 1, down[1] + 1];
    Object.assign(at("drawn").style, this.placed(this.box));
    at("drawn").hidden = false;
  }

  clicked(event) {
    const { box } = this;
    this.box = this.from = null;
    at("drawn").hidden = true;
    const pixel = this.pixel(event);
    if (!pixel || !event.detail) return;
    if (box) this.pick(`${this.view.name}:box:${box}`, event.shiftKey);
    else if (this.masks?.picking) this.masks.at(this.view.name, ...pixel, event.shiftKey);
    else this.hit(`${this.view.name}:${pixel}`, event.shiftKey, event.altKey);
  }
}

const AREA = /^(.+?)(?::(box|stroke))?:\s*([\d,\s]+)$/; // the notation of a pixel, a box or a stroke

// What a mask leaves out, under a veil; its edge in a colour.
export function veiled(mask, [r, g, b]) {
  const { data, width, height } = mask;
  const out = new ImageData(width, height);
  for (let place = 0; place < data.length; place += 4) if (data[place] < 128) out.data.set([8, 10, 14, 190], place);
  edge(mask, place => out.data.set([r, g, b, 255], 4 * place));
  return out;
}
