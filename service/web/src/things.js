// The things in the scene, which the lift found by masks alone: a list before anything is asked, and what a click takes.
import { at, el, plural, tell } from "./dom.js";
import { json, patch, words } from "./service.js";

const MOST = 100; // things in the list
const WHOLE = 0.5; // of the scene's splats: what has more is no thing, but what things stand on

export class Things {
  // hold: with the terms that are taken; held: those; fly: with a box to look at, and the view that shows most of it;
  // naming: names by terms.
  constructor({ hold, held, fly, naming }) {
    Object.assign(this, { hold, held, fly, naming, found: [] });
    at("catalogue-hidden").addEventListener("click", () => { this.all = !this.all; this.show(); });
  }

  async of(lift) {
    Object.assign(this, { lift, found: [], all: false });
    this.show();
    if (!lift?.links.objects) return; // of a lift from before there were any
    try {
      const route = `/lifts/${lift.id}/objects?limit=${MOST}`;
      const named = `${route}&encoder=${encodeURIComponent(lift.text_space)}`; // refused where that space has no table of words
      const { objects } = lift.text_space === "none" ? await json(route) : await json(named).catch(() => json(route));
      if (lift === this.lift) this.have(objects);
    } catch { /* asked in words all the same */ }
    this.show();
  }

  // Things of one name are numbered.
  have(objects) {
    this.found = objects;
    const times = new Map();
    for (const { name } of objects) times.set(name, (times.get(name) || 0) + 1);
    const seen = new Map();
    for (const thing of objects) {
      const number = (seen.get(thing.name) || 0) + 1;
      seen.set(thing.name, number);
      thing.title = !thing.name ? `Thing ${thing.id + 1}` : times.get(thing.name) > 1 ? `${thing.name} ${number}` : thing.name;
      this.naming.set(term(thing), thing.title);
    }
  }

  background(thing) {
    return thing.splats > WHOLE * this.lift.count;
  }

  show() {
    const held = this.held();
    const shown = this.found.filter(thing => !this.background(thing) && (this.all || !thing.hidden));
    const hidden = this.found.filter(thing => thing.hidden).length;
    at("catalogue").hidden = !this.found.length;
    at("catalogue-hidden").hidden = !hidden;
    at("catalogue-hidden").textContent = this.all ? "Leave out what is hidden" : `Show ${plural(hidden, "hidden thing")}`;
    at("catalogue-list").replaceChildren(...shown.map(thing => el("li", { className: thing.hidden ? "hidden-thing" : "" },
      el("button", { type: "button", className: "thing", "aria-pressed": String(held.includes(term(thing))), on: { click: event => this.press(thing, event.shiftKey) } },
        el("span", {}, thing.title, el("small", {}, plural(thing.splats, "splat")))),
      el("button", { type: "button", className: "plain", title: "Give it a name", "aria-label": `Name ${thing.title}`, on: { click: event => this.write(thing, event.target.closest("li")) } }, "\u270e"),
      el("button", { type: "button", className: "plain", "aria-label": `${thing.hidden ? "Show" : "Hide"} ${thing.title}`, on: { click: () => this.change(thing, { hidden: !thing.hidden }) } }, thing.hidden ? "Show" : "Hide"))));
  }

  // One alone, or beside those that are taken.
  press(thing, more) {
    const held = more ? this.held().filter(one => one.startsWith("object:")) : [];
    const own = term(thing);
    this.hold(held.includes(own) ? held.filter(one => one !== own) : [...held, own]);
    if (!more) this.fly(thing.box, thing.views[0]);
  }

  // The thing of a splat that was clicked; false where there is none, or it is taken already: then its patch is meant.
  async at(splat, more) {
    if (!this.found.length) return false;
    try {
      const { objects: [found] } = await json(`/lifts/${this.lift.id}/objects?splat=${splat}`);
      if (!found || this.background(found)) return false;
      const held = this.held();
      if (!more && held.length === 1 && held[0] === term(found)) return false;
      this.press(this.found.find(({ id }) => id === found.id) || { ...found, title: `Thing ${found.id + 1}` }, more);
      return true;
    } catch (problem) {
      tell(words(problem), true);
      return true;
    }
  }

  write(thing, item) {
    const input = el("input", { type: "text", className: "name", value: thing.name || "", maxLength: 100, "aria-label": `Name of ${thing.title}`,
      on: { change: () => this.change(thing, { name: input.value.trim() || null }), keydown: event => event.key === "Escape" && this.show(), blur: () => this.show() } });
    item.replaceChildren(input);
    input.focus();
  }

  async change(thing, change) {
    try {
      const { name, hidden } = await patch(`/lifts/${this.lift.id}/objects/${thing.id}`, change);
      Object.assign(thing, { hidden, ...("name" in change && { name }) });
      if (change.name === null) return await this.of(this.lift);
      this.have(this.found);
    } catch (problem) { tell(words(problem), true); }
    return this.show();
  }
}

const term = thing => `object:${thing.id}`;
