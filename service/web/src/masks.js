// Masks of the feature packs, picked in the photo view: the region under a click becomes an example.
import { byId, el, percent, notify } from "./dom.js";
import { fetchJson, fetchPicture, problemText } from "./service.js";

const REGION = /^region:(.+):(\d+):(\d+)$/;
const LINE = [255, 255, 255, 255];

export class MaskPicker {
  // onExample(term, less): add an example, with `less` a negative one. onReplace(old, term): replace an example.
  constructor({ onExample, onReplace }) {
    Object.assign(this, { onExample, onReplace, lift: null, regions: [], requestNumber: 0 });
    byId("pick-mask").addEventListener("click", () => this.setPicking(!this.isPicking));
  }

  get isPicking() {
    return byId("pick-mask").getAttribute("aria-pressed") === "true";
  }

  setPicking(on) {
    byId("pick-mask").setAttribute("aria-pressed", String(on));
    byId("picture").classList.toggle("masks", on);
  }

  // Show the button if the lift has masks; packs of feature grids have none.
  async setLift(lift) {
    Object.assign(this, { lift, regions: [] });
    this.setPicking(false);
    byId("pick-mask").hidden = true;
    this.listRegions([]);
    if (!lift?.features.length) return;
    const packs = await Promise.all(lift.features.map(id => fetchJson(`/assets/${id}`)));
    if (lift === this.lift) byId("pick-mask").hidden = !packs.some(({ counts }) => counts.region_maps);
  }

  // Use the smallest mask at a pixel as an example; the others at this pixel can replace it.
  async pickAt(view, x, y, less) {
    try {
      const { regions } = await fetchJson(`/lifts/${this.lift.id}/regions?${new URLSearchParams({ view, x, y })}`);
      if (!regions.length) return notify("No mask covers this pixel.");
      this.regions = regions;
      return this.onExample(regions[0].example, less);
    } catch (problem) {
      return notify(problem.status === 404 ? "This view was not lifted, so it has no masks. Choose another view." : problemText(problem), true);
    }
  }

  // List the masks at the last pixel while one of them is an example.
  listRegions(examples) {
    const active = examples.find(({ term }) => this.regions.some(({ example }) => example === term))?.term;
    byId("masks").hidden = !active || this.regions.length < 2;
    byId("masks-list").replaceChildren(...(active ? this.regions : []).map(({ example, share }) => el("button", {
      type: "button", "aria-pressed": String(example === active), on: { click: () => example !== active && this.onReplace(active, example) },
    }, `${percent(share)} of the view`)));
  }

  // Draw the outlines of masks that are examples over the view.
  async drawOutlines(view, examples) {
    const request = ++this.requestNumber;
    const canvas = byId("outline");
    const regions = examples.map(({ term }) => REGION.exec(term)).filter(match => match?.[1] === view);
    if (!regions.length) { canvas.hidden = true; return; }
    const address = ([, name, level, region]) => `/lifts/${this.lift.id}/regions/mask?${new URLSearchParams({ view: name, level, region })}`;
    try {
      const masks = await Promise.all(regions.map(region => fetchPicture(address(region))));
      for (const { src } of masks) URL.revokeObjectURL(src);
      if (request !== this.requestNumber) return;
      canvas.width = masks[0].naturalWidth;
      canvas.height = masks[0].naturalHeight;
      const outlines = new ImageData(canvas.width, canvas.height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      for (const mask of masks) {
        context.drawImage(mask, 0, 0);
        eachEdgePixel(context.getImageData(0, 0, canvas.width, canvas.height), pixel => outlines.data.set(LINE, 4 * pixel));
      }
      context.putImageData(outlines, 0, 0);
      canvas.hidden = false;
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }
}

// Call visit with each pixel of a white mask that touches a black one or the border of the picture.
export function eachEdgePixel({ data, width, height }, visit) {
  const inside = pixel => data[4 * pixel] > 127;
  for (let pixel = 0; pixel < width * height; pixel += 1) {
    const x = pixel % width;
    if (inside(pixel) && (!x || x === width - 1 || pixel < width || pixel >= width * (height - 1)
      || !inside(pixel - 1) || !inside(pixel + 1) || !inside(pixel - width) || !inside(pixel + width))) visit(pixel);
  }
}
