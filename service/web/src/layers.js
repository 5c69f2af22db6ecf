// The panel Layers: layers of colours in 3D and in photo views, the list of views, and the photo view, which needs no
// WebGL.
import { byId, el, fillSelect, notify } from "./dom.js";
import { queryString } from "./question.js";
import { fetchBytes, fetchJson, readNpy, fetchPicture, problemText } from "./service.js";

const PAGE_SIZE = 1000; // views of a request
const LAYERS = {
  rgb: "The colours of the splats.",
  pca: "The first three principal components of the features as red, green and blue. Similar colours are similar features.",
  cluster: "A colour for each cluster of the aggregation. Grey splats are in no cluster.",
  confidence: "The confidence of each splat's feature, by the regions of other views.",
  photo: "The photo of the view, if one was uploaded.",
  depth: "The depth of the splats.",
};
const SCALE_ENDS = { confidence: ["low", "high"], depth: ["far", "near"] }; // dark and bright
const CLICK_DISTANCE = 5; // pixels that the pointer may move during a click

export class LayerPanel {
  // onChange(): colours or the link must be updated. flyToView(view): move the camera. onExample(term, less): a box or a
  // stroke as an example. onPlace(term, shift, alt): a click, which may select an object.
  constructor({ onChange, flyToView, onExample, onPlace, fallback }) {
    Object.assign(this, { onChange, flyToView, onExample, onPlace, views: [], view: null, colourCache: new Map(), layerColours: null, requestNumber: 0, mode: fallback ? "view" : "scene" });
    this.fallback = fallback;
    for (const input of document.querySelectorAll("input[name=layer]")) input.addEventListener("change", () => this.setLayer(input.value));
    for (const input of document.querySelectorAll("input[name=mode]")) input.addEventListener("change", () => this.setMode(input.value));
    byId("cover").addEventListener("input", () => { this.blend(); this.onChange(); });
    byId("view").addEventListener("change", () => this.goToView(byId("view").value));
    byId("view-before").addEventListener("click", () => this.stepView(-1));
    byId("view-after").addEventListener("click", () => this.stepView(1));
    byId("picture").addEventListener("pointerdown", event => this.onPointerDown(event));
    byId("picture").addEventListener("pointermove", event => this.onPointerMove(event));
    byId("picture").addEventListener("click", event => this.onClick(event));
    byId("picture").addEventListener("dragstart", event => event.preventDefault()); // browsers drag images by default
  }

  get layerName() {
    return document.querySelector("input[name=layer]:checked").value;
  }

  async setLift(lift, viewName) {
    this.lift = lift;
    this.colourCache.clear();
    this.layerColours = null;
    this.views = [];
    this.showLayer("rgb");
    const clusters = lift.diagnostics?.clusters ?? lift.settings?.aggregation;
    byId("layer-cluster").hidden = !clusters;
    byId("layer-confidence").hidden = !lift.settings?.robust;
    byId("layer-photo").hidden = !lift.photos;
    const views = [];
    for (let next = 0; next !== null;) {
      const page = await fetchJson(`/lifts/${lift.id}/views?limit=${PAGE_SIZE}&cursor=${next}`);
      views.push(...page.views.filter(({ lifted }) => lifted));
      ({ next } = page);
    }
    if (lift !== this.lift) return;
    this.views = views;
    this.listViews(viewName);
  }

  listViews(viewName) {
    fillSelect(byId("view"), this.views.map(({ name }) => [name, name]), viewName);
    this.view = this.views.find(view => view.name === byId("view").value) || this.views[0] || null;
  }

  stepView(offset) {
    if (!this.views.length) return;
    const index = this.views.indexOf(this.view);
    this.goToView(this.views[(index + offset + this.views.length) % this.views.length].name);
  }

  goToView(name) {
    const view = this.views.find(entry => entry.name === name);
    if (!view) return;
    this.view = view;
    byId("view").value = name;
    this.flyToView(view);
    this.drawView();
    this.onChange();
  }

  setMode(mode) {
    this.mode = this.fallback || mode === "view" ? "view" : "scene"; // a link may have any value
    if (this.mode === "scene" && ["depth", "photo"].includes(this.layerName)) this.setLayer("rgb"); // these layers exist in photo views alone
    byId("stage").dataset.mode = this.mode;
    document.querySelector(`input[name=mode][value=${this.mode}]`).checked = true;
    this.drawView();
    this.onChange();
  }

  showLayer(name) {
    document.querySelector(`input[name=layer][value=${name}]`).checked = true;
    byId("layer-words").textContent = LAYERS[name];
    byId("cover-label").hidden = name === "rgb";
    byId("layer-scale").hidden = !Object.hasOwn(SCALE_ENDS, name);
    if (Object.hasOwn(SCALE_ENDS, name)) byId("layer-scale").querySelectorAll("span").forEach((end, index) => { end.textContent = SCALE_ENDS[name][index]; });
  }

  async setLayer(name) {
    if (!Object.hasOwn(LAYERS, name)) return undefined;
    this.showLayer(name);
    this.drawView();
    if (["rgb", "depth", "photo"].includes(name) || this.fallback) {
      this.layerColours = null;
      return this.onChange();
    }
    try {
      const { lift } = this;
      if (!this.colourCache.has(name)) this.colourCache.set(name, readNpy(await fetchBytes(`/lifts/${lift.id}/colours?layer=${name}`)));
      if (lift !== this.lift || name !== this.layerName) return;
      this.layerColours = this.colourCache.get(name);
      this.onChange();
    } catch (problem) {
      notify(problemText(problem), true);
      this.setLayer("rgb");
    }
  }

  paintedLayer() {
    return this.layerColours ? { colours: this.layerColours, cover: Number(byId("cover").value) / 100 } : null;
  }

  // Draw the photo view: the rendered view, the layer over it, and the mask of the question.
  async drawView() {
    const request = ++this.requestNumber;
    if (!this.lift || !this.view || this.mode === "scene") return;
    const showPicture = async (id, path) => {
      const image = byId(id);
      const oldSource = image.src;
      const loaded = path && await fetchPicture(path);
      if (request !== this.requestNumber) return loaded && URL.revokeObjectURL(loaded.src);
      if (oldSource.startsWith("blob:")) URL.revokeObjectURL(oldSource);
      if (loaded) image.src = loaded.src; else image.removeAttribute("src");
      image.hidden = !loaded;
    };
    const address = queryString({ lift: this.lift.id, view: this.view.name });
    const overlay = this.layerName === "photo" ? this.view.photo && `/lifts/${this.lift.id}/photo?view=${encodeURIComponent(this.view.name)}`
      : this.layerName !== "rgb" ? `/render?${address}&channel=${this.layerName}` : null;
    byId("layer-words").textContent = this.layerName === "photo" && !this.view.photo ? "This view has no photo." : LAYERS[this.layerName];
    byId("picture-box").classList.add("busy");
    try {
      await Promise.all([showPicture("render", `/render?${address}&channel=rgb`), showPicture("over", overlay), this.drawMask(request)]);
      this.drawMarks();
    } catch (problem) {
      if (request === this.requestNumber) notify(problemText(problem), true);
    }
    if (request === this.requestNumber) byId("picture-box").classList.remove("busy");
    this.blend();
  }

  async drawMask(request) {
    const canvas = byId("mask");
    const source = this.maskSource?.(this.view.name);
    if (!source) { canvas.hidden = true; return; }
    const image = await fetchPicture(source.path, source.body);
    URL.revokeObjectURL(image.src);
    if (request !== this.requestNumber) return;
    canvas.width = image.naturalWidth;
    canvas.height = image.naturalHeight;
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(image, 0, 0);
    context.putImageData(source.paint(context.getImageData(0, 0, canvas.width, canvas.height)), 0, 0);
    canvas.hidden = false;
    canvas.dataset.view = this.view.name;
  }

  blend() {
    byId("over").style.opacity = Number(byId("cover").value) / 100;
  }

  // Mark the examples in this view.
  drawMarks() {
    for (const mark of byId("picture").querySelectorAll(".mark")) mark.remove();
    for (const { term, unlike } of this.examples?.() || []) {
      const [, view, kind, coordinates] = AREA.exec(term) || [];
      if (view !== this.view.name) continue;
      const numbers = coordinates.split(",").map(Number);
      if (kind === "box") this.drawMark(numbers, unlike);
      else for (let index = 0; index < numbers.length; index += 2) this.drawMark(numbers.slice(index, index + 2), unlike);
    }
  }

  drawMark([x0, y0, x1, y1], unlike) {
    const className = `mark${unlike ? " unlike" : ""}${x1 === undefined ? "" : " box"}`;
    byId("picture").append(el("span", { className, style: this.cssPlace(x1 === undefined ? [x0 + 0.5, y0 + 0.5] : [x0, y0, x1, y1]) }));
  }

  // CSS position of pixels of the view, in per cent of its picture.
  cssPlace([x0, y0, x1, y1]) {
    const { width, height } = this.view;
    const sides = x1 === undefined ? {} : { width: `${100 * (x1 - x0) / width}%`, height: `${100 * (y1 - y0) / height}%` };
    return { left: `${100 * x0 / width}%`, top: `${100 * y0 / height}%`, ...sides };
  }

  // The pixel under the pointer, or the nearest one at the border; null without a picture.
  pixel({ clientX, clientY }) {
    const { naturalWidth: width, naturalHeight: height } = byId("render");
    const box = byId("render").getBoundingClientRect();
    if (!width || !box.width) return null;
    const within = (share, side) => Math.max(0, Math.min(side - 1, Math.floor(share * side)));
    return [within((clientX - box.left) / box.width, width), within((clientY - box.top) / box.height, height)];
  }

  // A mouse or a pen draws a box; touch scrolls the page.
  onPointerDown(event) {
    this.dragStart = event.button === 0 && event.pointerType !== "touch" ? { pixel: this.pixel(event), x: event.clientX, y: event.clientY } : null;
    this.dragBox = null;
    byId("drawn").hidden = true;
    if (this.dragStart?.pixel) byId("picture").setPointerCapture(event.pointerId);
  }

  onPointerMove(event) {
    const { dragStart: from } = this;
    if (!from?.pixel || !event.buttons || (!this.dragBox && Math.hypot(event.clientX - from.x, event.clientY - from.y) <= CLICK_DISTANCE)) return;
    const [xRange, yRange] = [0, 1].map(axis => [from.pixel[axis], this.pixel(event)[axis]].sort((a, b) => a - b));
    this.dragBox = [xRange[0], yRange[0], xRange[1] + 1, yRange[1] + 1];
    Object.assign(byId("drawn").style, this.cssPlace(this.dragBox));
    byId("drawn").hidden = false;
  }

  onClick(event) {
    const { dragBox: box } = this;
    this.dragBox = this.dragStart = null;
    byId("drawn").hidden = true;
    const pixel = this.pixel(event);
    if (!pixel || !event.detail) return;
    if (box) this.onExample(`${this.view.name}:box:${box}`, event.shiftKey);
    else this.onPlace(`${this.view.name}:${pixel}`, event.shiftKey, event.altKey);
  }
}

const AREA = /^(.+?)(?::(box|stroke))?:\s*([\d,\s]+)$/; // the notation of a pixel, a box or a stroke

// A dark layer outside a mask, with the edge of the mask in a colour.
export function veilMask(mask, [r, g, b]) {
  const { data, width, height } = mask;
  const out = new ImageData(width, height);
  for (let index = 0; index < data.length; index += 4) if (data[index] < 128) out.data.set([8, 10, 14, 190], index);
  eachEdgePixel(mask, index => out.data.set([r, g, b, 255], 4 * index));
  return out;
}

// Call visit with each pixel of a white mask that touches a black one or the border of the picture.
function eachEdgePixel({ data, width, height }, visit) {
  const inside = pixel => data[4 * pixel] > 127;
  for (let pixel = 0; pixel < width * height; pixel += 1) {
    const x = pixel % width;
    if (inside(pixel) && (!x || x === width - 1 || pixel < width || pixel >= width * (height - 1)
      || !inside(pixel - 1) || !inside(pixel + 1) || !inside(pixel - width) || !inside(pixel + width))) visit(pixel);
  }
}
