// Masks of the feature packs, picked in the photo's view: the region under a click is an example to ask by.
import { at, el, percent, notify } from "./dom.js";
import { json, picture, words } from "./service.js";

const REGION = /^region:(.+):(\d+):(\d+)$/;
const LINE = [255, 255, 255, 255];

export class Masks {
  // pick: with an example and whether it is one of what it is not; swap: with an example and the one that takes its place.
  constructor({ pick, swap }) {
    Object.assign(this, { pick, swap, lift: null, around: [], turn: 0 });
    at("pick-mask").addEventListener("click", () => this.press(!this.picking));
  }

  get picking() {
    return at("pick-mask").getAttribute("aria-pressed") === "true";
  }

  press(on) {
    at("pick-mask").setAttribute("aria-pressed", String(on));
    at("picture").classList.toggle("masks", on);
  }

  // Packs of grids have none.
  async of(lift) {
    Object.assign(this, { lift, around: [] });
    this.press(false);
    at("pick-mask").hidden = true;
    this.list([]);
    if (!lift?.features.length) return;
    const packs = await Promise.all(lift.features.map(id => json(`/assets/${id}`)));
    if (lift === this.lift) at("pick-mask").hidden = !packs.some(({ counts }) => counts.region_maps);
  }

  // The smallest mask at a pixel becomes the example; the others that cover it can take its place.
  async at(view, x, y, less) {
    try {
      const { regions } = await json(`/lifts/${this.lift.id}/regions?${new URLSearchParams({ view, x, y })}`);
      if (!regions.length) return notify("No mask covers this place.");
      this.around = regions;
      return this.pick(regions[0].example, less);
    } catch (problem) {
      return notify(problem.status === 404 ? "This view was not lifted, so it has no masks: take another." : words(problem), true);
    }
  }

  // After what is asked has changed: the masks of the last pixel, while one of them is asked.
  list(asked) {
    const now = asked.find(({ term }) => this.around.some(({ example }) => example === term))?.term;
    at("masks").hidden = !now || this.around.length < 2;
    at("masks-list").replaceChildren(...(now ? this.around : []).map(({ example, share }) => el("button", {
      type: "button", "aria-pressed": String(example === now), on: { click: () => example !== now && this.swap(now, example) },
    }, `${percent(share)} of the view`)));
  }

  // The outlines of asked masks over the view's picture.
  async outline(view, asked) {
    const mine = ++this.turn;
    const canvas = at("outline");
    const regions = asked.map(({ term }) => REGION.exec(term)).filter(found => found?.[1] === view);
    if (!regions.length) { canvas.hidden = true; return; }
    const address = ([, name, level, region]) => `/lifts/${this.lift.id}/regions/mask?${new URLSearchParams({ view: name, level, region })}`;
    try {
      const masks = await Promise.all(regions.map(region => picture(address(region))));
      for (const { src } of masks) URL.revokeObjectURL(src);
      if (mine !== this.turn) return;
      canvas.width = masks[0].naturalWidth;
      canvas.height = masks[0].naturalHeight;
      const drawn = new ImageData(canvas.width, canvas.height);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      for (const mask of masks) {
        context.drawImage(mask, 0, 0);
        edge(context.getImageData(0, 0, canvas.width, canvas.height), place => drawn.data.set(LINE, 4 * place));
      }
      context.putImageData(drawn, 0, 0);
      canvas.hidden = false;
    } catch (problem) {
      notify(words(problem), true);
    }
  }
}

// Each pixel of a white mask that touches what is black, or the picture's rim.
export function edge({ data, width, height }, each) {
  const inside = place => data[4 * place] > 127;
  for (let place = 0; place < width * height; place += 1) {
    const x = place % width;
    if (inside(place) && (!x || x === width - 1 || place < width || place >= width * (height - 1)
      || !inside(place - 1) || !inside(place + 1) || !inside(place - width) || !inside(place + width))) each(place);
  }
}
