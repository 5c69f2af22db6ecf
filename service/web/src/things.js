// The things in the scene, which the lift found by masks alone, and their parts: a list before anything is asked, and
// what a click takes.
import { at, count, el, plural, notify, twice } from "./dom.js";
import { search } from "./question.js";
import { json, patch, picture, post, remove, words } from "./service.js";

const MOST = 100; // things in the list
const NODES = 1000; // of the tree, things among them
const WHOLE = 0.5; // of the scene's splats: what has more is no thing, but what things stand on

export class Things {
  // hold: with the terms that are taken; held: those; fly: with a box to look at, and the view that shows most of it;
  // naming: names by terms.
  constructor({ hold, held, fly, naming }) {
    Object.assign(this, { hold, held, fly, naming, found: [], own: [], nodes: new Map(), open: new Set() });
    at("join").addEventListener("click", () => this.join());
    at("catalogue-hidden").addEventListener("click", () => { this.all = !this.all; this.show(); });
  }

  async of(lift) {
    Object.assign(this, { lift, found: [], own: [], last: null, undone: null, nodes: new Map(), open: new Set(), all: false });
    at("catalogue-most").textContent = "";
    this.show();
    if (lift) json(`/lifts/${lift.id}/selections`).then(({ selections }) => { if (lift === this.lift) this.have(this.found, selections); }).then(() => this.show(), () => {});
    if (!lift?.links.objects) return; // of a lift from before there were any
    try {
      const { objects, named, count: all } = await objectsOf(lift);
      if (lift === this.lift) this.have(objects);
      if (lift === this.lift && all > objects.length) at("catalogue-most").textContent = `These are the first ${count(objects.length)} of ${count(all)}. A click takes the others, too.`;
      this.show();
      const { nodes } = objects.length && lift.links.tree ? await json(`${lift.links.tree}?limit=${NODES}${named}`) : { nodes: [] };
      if (lift === this.lift) this.nodes = new Map(nodes.map(node => [node.id, node]));
      if (lift === this.lift) this.have(this.found);
    } catch { /* asked in words all the same */ }
    this.show();
  }

  have(objects, own = this.own) {
    Object.assign(this, { found: objects, own });
    for (const { id, name } of own) this.naming.set(`selection:${id}`, name);
    entitle(objects);
    for (const thing of objects) {
      this.naming.set(term(thing), thing.title);
      this.entitle(thing);
    }
  }

  // Parts are numbered within their whole, which their names say where a part is met alone.
  entitle(whole) {
    this.parts(whole).forEach((part, place) => {
      part.title = `${part.name ? `${part.name}, part` : "Part"} ${place + 1}`;
      this.naming.set(term(part), `${this.naming.get(term(whole))}: ${part.title.toLowerCase()}`);
      this.entitle(part);
    });
  }

  parts({ id }) {
    return (this.nodes.get(id)?.parts ?? []).map(part => this.nodes.get(part)).filter(Boolean);
  }

  background(thing) {
    return thing.splats > WHOLE * this.lift.count;
  }

  show() {
    const held = this.held();
    const shown = this.found.filter(thing => !this.background(thing) && (this.all || !thing.hidden));
    const hidden = this.found.filter(thing => thing.hidden).length;
    at("catalogue").hidden = !this.found.length && !this.own.length;
    at("join").hidden = held.length < 2;
    at("catalogue-own").replaceChildren(...this.own.map(one => el("li", {},
      el("button", { type: "button", className: "thing", "aria-pressed": String(held.includes(`selection:${one.id}`)), on: { click: event => this.pressOwn(one, event.shiftKey) } },
        el("span", {}, one.name, el("small", {}, `${plural(one.count, "splat")}, yours`))),
      twice("Delete", () => this.drop(one.id)))));
    at("catalogue-hidden").hidden = !hidden;
    at("catalogue-hidden").textContent = this.all ? "Leave out what is hidden" : `Show ${plural(hidden, "hidden thing")}`;
    const focus = document.activeElement?.dataset.unfolds; // which is made anew
    at("catalogue-list").replaceChildren(...shown.map(thing => el("li", { className: thing.hidden ? "hidden-thing" : "" }, ...this.line(thing, held),
      el("button", { type: "button", className: "plain edit", title: "Give it a name", "aria-label": `Name ${thing.title}`, on: { click: event => this.write(thing, event.target.closest("li")) } }, "\u270e"),
      el("button", { type: "button", className: "plain edit", "aria-label": `${thing.hidden ? "Show" : "Hide"} ${thing.title}`, on: { click: () => this.change(thing, { hidden: !thing.hidden }) } }, thing.hidden ? "Show" : "Hide"),
      ...this.below(thing, held))));
    if (focus) at("catalogue-list").querySelector(`[data-unfolds="${focus}"]`)?.focus();
  }

  // What takes a thing or a part, after what unfolds its parts where it has any.
  line(node, held) {
    const parts = this.parts(node);
    const opened = this.open.has(node.id);
    const unfolds = el("button", { type: "button", className: "plain unfold", "aria-expanded": String(opened), "aria-controls": `parts-${node.id}`,
      "aria-label": `${plural(parts.length, "part")} of ${this.naming.get(term(node))}`, data: { unfolds: node.id }, on: { click: () => this.unfold(node) } }, opened ? "\u25be" : "\u25b8");
    return [...(parts.length ? [unfolds] : []),
      el("button", { type: "button", className: "thing", "aria-pressed": String(held.includes(term(node))), on: { click: event => this.press(node, event.shiftKey) } },
        el("span", {}, node.title, el("small", {}, plural(node.splats, "splat"), parts.length ? `, ${plural(parts.length, "part")}` : "")))];
  }

  below(node, held) {
    const parts = this.parts(node);
    if (!parts.length) return [];
    const items = this.open.has(node.id) ? parts.map(part => el("li", {}, ...this.line(part, held), ...this.below(part, held))) : [];
    return [el("ol", { id: `parts-${node.id}`, className: "parts", "aria-label": `Parts of ${this.naming.get(term(node))}`, hidden: !items.length }, ...items)];
  }

  unfold({ id }) {
    if (!this.open.delete(id)) this.open.add(id);
    this.show();
  }

  // One alone, or beside those that are taken.
  press(thing, more) {
    this.take(term(thing), more);
    if (!more) this.fly(thing.box, thing.views[0]);
  }

  pressOwn(one, more) {
    this.take(`selection:${one.id}`, more);
    if (!more && one.box) this.fly(one.box);
  }

  // Several that are taken become one, and are hidden themselves.
  async join() {
    const sets = [...this.held()];
    const named = this.found.find(thing => thing.name && sets.includes(term(thing)));
    await this.make({ hidden: sets, before: sets, create: async add => [await add(named?.name ?? this.naming.get(sets[0]), sets)] });
  }

  // What a selection leaves of the thing that it was begun from becomes another one.
  async split(selection) {
    const [from] = wholeOf(selection);
    const corrected = `selection:${selection.id}`;
    await this.make({ hidden: [from], before: [corrected], then: corrected, step: selection.step, create: async add => {
      const rest = await add(`${this.naming.get(from)}, the rest`, [from]);
      return [await post(`${this.route}/${rest.id}/edits`, { operation: "remove", query: { sets: [corrected] } })];
    } });
  }

  // Things of one's own in place of others, which can be undone and redone. then: what is taken afterwards, if not
  // those; step: of the selection that they are made of.
  async make(change) {
    const { hidden, before, create, then } = change;
    this.undone = null;
    try {
      const made = await create((name, sets) => post(this.route, { name: name.slice(0, 100), edit: { operation: "set", query: { sets } } }));
      await this.conceal(hidden, true);
      const after = then ?? `selection:${made[0].id}`;
      const ids = made.map(({ id }) => id);
      this.last = { held: after, change, back: () => this.forget(ids).then(() => this.conceal(hidden, false)).then(() => this.hold(before)) };
      this.have(this.found, [...made, ...this.own]);
      this.hold([after]);
    } catch (problem) { notify(words(problem), true); }
  }

  // Take the last of these back, or make it again, where what is asked is still what it left; whether there was one.
  // selection: what is corrected by hand.
  go(by, selection) {
    const { last, undone } = this;
    if (by > 0) {
      if (!undone || String(this.held()) !== String(undone.before) || undone.step !== selection?.step) return false;
      this.make(undone);
      return true;
    }
    if (!last || String(this.held()) !== last.held) return false;
    this.last = null;
    last.back().then(() => { this.undone = last.change; }).catch(problem => notify(words(problem), true));
    return true;
  }

  // Delete one of one's own: what it was made of, and nothing else stands for, comes back. This can be undone, too.
  async drop(id) {
    const before = [...this.held()];
    const whole = await this.detail(id);
    await this.forget([id]);
    const others = await Promise.all(this.own.map(one => this.detail(one.id)));
    const hidden = begunFrom(whole.history).filter(set => !others.some(({ history }) => begunFrom(history).includes(set)) && this.found.some(thing => thing.hidden && term(thing) === set));
    await this.conceal(hidden, false);
    const left = before.filter(set => set !== `selection:${id}`);
    this.undone = null;
    this.last = { held: String(left), change: null, back: () => this.restore(whole, hidden, before) };
    if (left.length < before.length) this.hold(left); else this.show();
    notify(`\u201c${whole.name}\u201d is deleted. Ctrl+Z brings it back.`);
  }

  // A selection that was deleted, begun from what it was begun from, with the splats that it had.
  async restore({ id, name, history, bits }, hidden, before) {
    const begun = begunFrom(history);
    const splats = { operation: "set", bits };
    const made = await post(this.route, { name, edit: begun.length ? { how: "set", query: { sets: begun } } : splats });
    const whole = begun.length ? await post(`${this.route}/${made.id}/edits`, splats) : made;
    await this.conceal(hidden, true);
    this.have(this.found, [whole, ...this.own]);
    this.hold(before.map(set => (set === `selection:${id}` ? `selection:${made.id}` : set)));
    this.show();
  }

  detail(id) {
    return json(`${this.route}/${id}?bits=true`);
  }

  async forget(ids) {
    for (const id of ids) await remove(`${this.route}/${id}`);
    this.have(this.found, this.own.filter(({ id }) => !ids.includes(id)));
    this.show();
  }

  async conceal(terms, hidden) {
    for (const thing of this.found.filter(one => terms.includes(term(one)))) Object.assign(thing, await patch(`/lifts/${this.lift.id}/objects/${thing.id}`, { hidden }), { name: thing.name });
  }

  // A selection that was begun, changed or named elsewhere.
  changed(selection) {
    this.have(this.found, [selection, ...this.own.filter(({ id }) => id !== selection.id)]);
    this.show();
  }

  get route() {
    return `/lifts/${this.lift.id}/selections`;
  }

  // What a ZIP of all things has: those that are shown, and one's own.
  shown() {
    return [...this.own.map(({ id, name }) => ({ sets: [`selection:${id}`], name })),
      ...this.found.filter(thing => !thing.hidden && !this.background(thing)).map(thing => ({ sets: [term(thing)], name: thing.title }))];
  }

  take(own, more) {
    const held = more ? this.held().filter(one => /^(object|selection):/.test(one)) : [];
    this.hold(held.includes(own) ? held.filter(one => one !== own) : [...held, own]);
  }

  // What a click on an example may mean: the thing there, with another click its part, and so on to the smallest; false
  // where there is none, or that is taken already: then what is like the place is meant.
  async at(example, more) {
    if (!this.found.length) return false;
    try {
      const { candidates } = await json(`/query?${search({ lift: this.lift.id, like: example, top: 0 })}`);
      const nested = candidates.filter(one => one.kind !== "group" && !this.background(one)).reverse(); // the largest first
      if (!nested.length) return false;
      nested.unshift(...await this.heir(example, nested));
      const held = this.held();
      const taken = more || held.length !== 1 ? -1 : nested.findIndex(one => one.set === held[0]);
      if (taken === nested.length - 1) return false;
      const chosen = nested[taken + 1];
      for (const { id } of nested.slice(0, taken + 1)) if (id !== undefined) this.open.add(id);
      this.take(chosen.set, more);
      return true;
    } catch (problem) {
      notify(words(problem), true);
      return true;
    }
  }

  // The one of one's own things that stands for a hidden one where a click is: what was joined, or a side of what was
  // split. [] where nothing does.
  async heir(example, nested) {
    const hidden = this.found.filter(thing => thing.hidden).map(term);
    const here = nested.map(({ set }) => set).filter(set => hidden.includes(set));
    if (!here.length) return [];
    const own = await Promise.all(this.own.map(({ id }) => this.detail(id)));
    const stands = ({ history }) => begunFrom(history).some(set => here.includes(set) || own.some(one => set === `selection:${one.id}` && stands(one)));
    const heirs = own.filter(stands);
    const splat = /^splat:(\d+)$/.exec(example);
    for (const one of heirs) {
      const set = `selection:${one.id}`;
      if (splat ? bit(one.bits, Number(splat[1])) : heirs.length === 1 || await this.drawn(set, example)) return [{ set }];
    }
    return [];
  }

  // Whether a picture's mask of a set has the pixel of an example.
  async drawn(set, example) {
    const [, view, x, y] = /^(.*):(\d+),(\d+)$/.exec(example) ?? [];
    if (view === undefined) return false;
    const context = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d");
    const mask = await picture(`/query/mask?${search({ lift: this.lift.id, sets: set, view })}`);
    context.drawImage(mask, -x, -y);
    URL.revokeObjectURL(mask.src);
    return context.getImageData(0, 0, 1, 1).data[0] > 127;
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
    } catch (problem) { notify(words(problem), true); }
    return this.show();
  }
}

// The first things of a lift, how many there are, and the part of the route that had them named.
async function objectsOf(lift) {
  const route = `/lifts/${lift.id}/objects?limit=${MOST}`;
  let named = lift.text_space === "none" ? "" : `&encoder=${encodeURIComponent(lift.text_space)}`;
  const { objects, count: all } = await json(route + named).catch(() => { named = ""; return json(route); }); // that space has no table of words
  return { objects, named, count: all };
}

// Things of one name are numbered.
function entitle(objects) {
  const times = new Map();
  for (const { name } of objects) times.set(name, (times.get(name) || 0) + 1);
  const seen = new Map();
  for (const thing of objects) {
    const number = (seen.get(thing.name) || 0) + 1;
    seen.set(thing.name, number);
    thing.title = !thing.name ? `Thing ${thing.id + 1}` : times.get(thing.name) > 1 ? `${thing.name} ${number}` : thing.name;
  }
}

// The titles of sets of any lift, by their terms.
export async function titlesOf(lift, sets) {
  const titles = new Map();
  const selections = sets.filter(set => set.startsWith("selection:"));
  await Promise.all(selections.map(async set => titles.set(set, (await json(`/lifts/${lift.id}/selections/${set.slice(10)}`)).name)));
  if (selections.length === sets.length) return titles;
  const { objects } = await objectsOf(lift);
  entitle(objects);
  for (const thing of objects) titles.set(term(thing), thing.title);
  return titles;
}

// The sets that a selection was begun from.
const begunFrom = history => history?.[0]?.edit.query?.sets ?? [];

// Whether a splat is in bits of a selection, in base64, the first the lowest of its byte.
const bit = (bits, splat) => atob(bits).charCodeAt(splat >> 3) >> (splat & 7) & 1;

// The one thing that a selection was begun from, in a list.
export const wholeOf = ({ history }) => {
  const sets = begunFrom(history);
  return sets.length === 1 && sets[0].startsWith("object:") ? sets : [];
};
const term = thing => `object:${thing.id}`;
