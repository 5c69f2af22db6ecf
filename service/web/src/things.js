// The things in the scene, which the lift found by masks alone: a list before anything is asked.
import { at, el, plural } from "./dom.js";
import { json } from "./service.js";

const MOST = 100; // things in the list
const COLOUR = "#ffffff";

export class Things {
  // changed: when the chosen box must follow; fly: with a box to look at, and the view that shows most of it.
  constructor({ changed, fly }) {
    Object.assign(this, { changed, fly, found: [], chosen: null });
  }

  async of(lift) {
    Object.assign(this, { lift, found: [], chosen: null });
    this.show();
    if (!lift?.links.objects) return; // of a lift from before there were any
    try {
      const route = `/lifts/${lift.id}/objects?limit=${MOST}`;
      const named = `${route}&encoder=${encodeURIComponent(lift.text_space)}`; // refused where that space has no table of words
      const { objects } = lift.text_space === "none" ? await json(route) : await json(named).catch(() => json(route));
      if (lift === this.lift) this.found = objects;
    } catch { /* asked in words all the same */ }
    this.show();
  }

  // Nothing of it is outlined when something is asked.
  rest() {
    this.chosen = null;
    this.show();
  }

  boxes() {
    return this.chosen ? [{ ...this.chosen.box, colour: COLOUR, name: title(this.chosen), of: 1, strong: true }] : [];
  }

  show() {
    at("catalogue").hidden = !this.found.length;
    at("catalogue-list").replaceChildren(...this.found.map(thing => el("li", {},
      el("button", { type: "button", className: "thing", "aria-pressed": String(thing === this.chosen), on: { click: () => this.choose(thing) } },
        el("b", {}, String(thing.id + 1)), el("span", {}, title(thing), el("small", {}, plural(thing.splats, "splat")))))));
  }

  choose(thing) {
    this.chosen = thing === this.chosen ? null : thing;
    this.show();
    this.changed();
    if (this.chosen) this.fly(thing.box, thing.views[0]);
  }
}

const title = thing => thing.name || `Thing ${thing.id + 1}`;
