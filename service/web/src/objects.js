// The list of objects that the lift made of its masks, with their parts, and of selections; a click selects one of them.
import { byId, formatCount, el, plural, notify, confirmButton } from "./dom.js";
import { queryString } from "./question.js";
import { fetchJson, patch, fetchPicture, post, remove, problemText } from "./service.js";

const MAX_OBJECTS = 100; // objects of the list
const MAX_NODES = 1000; // objects and parts of the tree
const BACKGROUND_SHARE = 0.5; // of the scene's splats: an object with more of them is background

export class ObjectList {
  // selectSets(terms), selectedSets(): the sets of the current question. flyToBox(box, view): move the camera; the view
  // shows most of the box. namesByTerm: a Map of names of objects and selections.
  constructor({ selectSets, selectedSets, flyToBox, namesByTerm }) {
    Object.assign(this, { selectSets, selectedSets, flyToBox, namesByTerm, items: [], selections: [], nodes: new Map(), openNodes: new Set() });
    byId("join").addEventListener("click", () => this.join());
    byId("catalogue-hidden").addEventListener("click", () => { this.showsHidden = !this.showsHidden; this.render(); });
  }

  async setLift(lift) {
    Object.assign(this, { lift, items: [], selections: [], lastChange: null, undoneChange: null, nodes: new Map(), openNodes: new Set(), showsHidden: false });
    byId("catalogue-most").textContent = "";
    this.render();
    if (lift) fetchJson(`/lifts/${lift.id}/selections`).then(({ selections }) => { if (lift === this.lift) this.setObjects(this.items, selections); }).then(() => this.render(), () => {});
    if (!lift?.links.objects) return; // old lifts have no objects
    try {
      const { objects, encoderQuery, total } = await fetchObjects(lift);
      if (lift === this.lift) this.setObjects(objects);
      if (lift === this.lift && total > objects.length) byId("catalogue-most").textContent = `The first ${formatCount(objects.length)} of ${formatCount(total)} objects. Click in the scene to select others.`;
      this.render();
      const { nodes } = objects.length && lift.links.tree ? await fetchJson(`${lift.links.tree}?limit=${MAX_NODES}${encoderQuery}`) : { nodes: [] };
      if (lift === this.lift) this.nodes = new Map(nodes.map(node => [node.id, node]));
      if (lift === this.lift) this.setObjects(this.items);
    } catch { /* words still work */ }
    this.render();
  }

  setObjects(objects, selections = this.selections) {
    Object.assign(this, { items: objects, selections });
    for (const { id, name } of selections) this.namesByTerm.set(`selection:${id}`, name);
    titleObjects(objects);
    for (const object of objects) {
      this.namesByTerm.set(term(object), object.title);
      this.titleParts(object);
    }
  }

  // Number the parts of an object; the name of a part begins with that of the object.
  titleParts(object) {
    this.parts(object).forEach((part, index) => {
      part.title = `${part.name ? `${part.name}, part` : "Part"} ${index + 1}`;
      this.namesByTerm.set(term(part), `${this.namesByTerm.get(term(object))}: ${part.title.toLowerCase()}`);
      this.titleParts(part);
    });
  }

  parts({ id }) {
    return (this.nodes.get(id)?.parts ?? []).map(part => this.nodes.get(part)).filter(Boolean);
  }

  isBackground(object) {
    return object.splats > BACKGROUND_SHARE * this.lift.count;
  }

  render() {
    const selected = this.selectedSets();
    const visible = this.items.filter(object => !this.isBackground(object) && (this.showsHidden || !object.hidden));
    const hidden = this.items.filter(object => object.hidden).length;
    byId("catalogue").hidden = !this.items.length && !this.selections.length;
    byId("join").hidden = selected.length < 2;
    byId("catalogue-own").replaceChildren(...this.selections.map(selection => el("li", {},
      el("button", { type: "button", className: "object", "aria-pressed": String(selected.includes(`selection:${selection.id}`)), on: { click: event => this.selectSelection(selection, event.shiftKey) } },
        el("span", {}, selection.name, el("small", {}, `${plural(selection.count, "splat")}, selection`))),
      confirmButton("Delete", () => this.deleteSelection(selection.id)))));
    byId("catalogue-hidden").hidden = !hidden;
    byId("catalogue-hidden").textContent = this.showsHidden ? "Hide the hidden objects" : `Show ${plural(hidden, "hidden object")}`;
    const focusedId = document.activeElement?.dataset.unfolds; // the button is replaced
    byId("catalogue-list").replaceChildren(...visible.map(object => el("li", { className: object.hidden ? "hidden-object" : "" }, ...this.objectButtons(object, selected),
      el("button", { type: "button", className: "plain edit", title: "Name this object", "aria-label": `Name ${object.title}`, on: { click: event => this.editName(object, event.target.closest("li")) } }, "\u270e"),
      el("button", { type: "button", className: "plain edit", "aria-label": `${object.hidden ? "Show" : "Hide"} ${object.title}`, on: { click: () => this.changeObject(object, { hidden: !object.hidden }) } }, object.hidden ? "Show" : "Hide"),
      ...this.partList(object, selected))));
    if (focusedId) byId("catalogue-list").querySelector(`[data-unfolds="${focusedId}"]`)?.focus();
  }

  // The button that selects an object or a part, after the one that shows its parts, if it has any.
  objectButtons(node, selected) {
    const parts = this.parts(node);
    const isOpen = this.openNodes.has(node.id);
    const toggle = el("button", { type: "button", className: "plain unfold", "aria-expanded": String(isOpen), "aria-controls": `parts-${node.id}`,
      "aria-label": `${plural(parts.length, "part")} of ${this.namesByTerm.get(term(node))}`, data: { unfolds: node.id }, on: { click: () => this.toggleParts(node) } }, isOpen ? "\u25be" : "\u25b8");
    return [...(parts.length ? [toggle] : []),
      el("button", { type: "button", className: "object", "aria-pressed": String(selected.includes(term(node))), on: { click: event => this.selectObject(node, event.shiftKey) } },
        el("span", {}, node.title, el("small", {}, plural(node.splats, "splat"), parts.length ? `, ${plural(parts.length, "part")}` : "")))];
  }

  partList(node, selected) {
    const parts = this.parts(node);
    if (!parts.length) return [];
    const items = this.openNodes.has(node.id) ? parts.map(part => el("li", {}, ...this.objectButtons(part, selected), ...this.partList(part, selected))) : [];
    return [el("ol", { id: `parts-${node.id}`, className: "parts", "aria-label": `Parts of ${this.namesByTerm.get(term(node))}`, hidden: !items.length }, ...items)];
  }

  toggleParts({ id }) {
    if (!this.openNodes.delete(id)) this.openNodes.add(id);
    this.render();
  }

  // Select an object alone, or add it to the selected ones.
  selectObject(object, extend) {
    this.toggleSet(term(object), extend);
    if (!extend) this.flyToBox(object.box, object.views[0]);
  }

  selectSelection(selection, extend) {
    this.toggleSet(`selection:${selection.id}`, extend);
    if (!extend && selection.box) this.flyToBox(selection.box);
  }

  // Join the selected objects into one selection and hide them.
  async join() {
    const sets = [...this.selectedSets()];
    const namedObject = this.items.find(object => object.name && sets.includes(term(object)));
    await this.replaceSets({ hidden: sets, before: sets, create: async add => [await add(namedObject?.name ?? this.namesByTerm.get(sets[0]), sets)] });
  }

  // Make a selection of the splats of an object that the edited selection leaves out.
  async split(selection) {
    const [source] = sourceObject(selection);
    const edited = `selection:${selection.id}`;
    await this.replaceSets({ hidden: [source], before: [edited], then: edited, step: selection.step, create: async add => {
      const remainder = await add(`${this.namesByTerm.get(source)}, the rest`, [source]);
      return [await post(`${this.route}/${remainder.id}/edits`, { operation: "remove", query: { sets: [edited] } })];
    } });
  }

  // Replace objects by new selections; the change can be undone and redone. hidden: the terms to hide. before: the
  // selected terms. create(add): make the selections. then: the term to select, if not the first new one. step: the
  // history step of the selection that they are made of.
  async replaceSets(change) {
    const { hidden, before, create, then } = change;
    this.undoneChange = null;
    try {
      const created = await create((name, sets) => post(this.route, { name: name.slice(0, 100), edit: { operation: "set", query: { sets } } }));
      await this.setHidden(hidden, true);
      const selected = then ?? `selection:${created[0].id}`;
      const ids = created.map(({ id }) => id);
      this.lastChange = { selected, change, revert: () => this.removeSelections(ids).then(() => this.setHidden(hidden, false)).then(() => this.selectSets(before)) };
      this.setObjects(this.items, [...created, ...this.selections]);
      this.selectSets([selected]);
    } catch (problem) { notify(problemText(problem), true); }
  }

  // Undo (-1) or redo (1) the last change if the same sets are selected as after it. False if there is nothing to do.
  // selection: the one that is edited.
  stepHistory(direction, selection) {
    const { lastChange: last, undoneChange: undone } = this;
    if (direction > 0) {
      if (!undone || String(this.selectedSets()) !== String(undone.before) || undone.step !== selection?.step) return false;
      this.replaceSets(undone);
      return true;
    }
    if (!last || String(this.selectedSets()) !== last.selected) return false;
    this.lastChange = null;
    last.revert().then(() => { this.undoneChange = last.change; }).catch(problem => notify(problemText(problem), true));
    return true;
  }

  // Delete a selection and show the objects again that it replaced, unless another selection replaces them. It can be
  // undone.
  async deleteSelection(id) {
    const before = [...this.selectedSets()];
    const deleted = await this.readSelection(id);
    await this.removeSelections([id]);
    const remaining = await Promise.all(this.selections.map(selection => this.readSelection(selection.id)));
    const hidden = sourceSets(deleted.history).filter(set => !remaining.some(({ history }) => sourceSets(history).includes(set)) && this.items.some(object => object.hidden && term(object) === set));
    await this.setHidden(hidden, false);
    const remainingSets = before.filter(set => set !== `selection:${id}`);
    this.undoneChange = null;
    this.lastChange = { selected: String(remainingSets), change: null, revert: () => this.restore(deleted, hidden, before) };
    if (remainingSets.length < before.length) this.selectSets(remainingSets); else this.render();
    notify(`\u201c${deleted.name}\u201d is deleted. Ctrl+Z restores it.`);
  }

  // Make a deleted selection again, from its source sets and with its splats.
  async restore({ id, name, history, bits }, hidden, before) {
    const sources = sourceSets(history);
    const splatEdit = { operation: "set", bits };
    const created = await post(this.route, { name, edit: sources.length ? { operation: "set", query: { sets: sources } } : splatEdit });
    const restored = sources.length ? await post(`${this.route}/${created.id}/edits`, splatEdit) : created;
    await this.setHidden(hidden, true);
    this.setObjects(this.items, [restored, ...this.selections]);
    this.selectSets(before.map(set => (set === `selection:${id}` ? `selection:${created.id}` : set)));
    this.render();
  }

  readSelection(id) {
    return fetchJson(`${this.route}/${id}?bits=true`);
  }

  async removeSelections(ids) {
    for (const id of ids) await remove(`${this.route}/${id}`);
    this.setObjects(this.items, this.selections.filter(({ id }) => !ids.includes(id)));
    this.render();
  }

  async setHidden(terms, hidden) {
    for (const object of this.items.filter(entry => terms.includes(term(entry)))) Object.assign(object, await patch(`/lifts/${this.lift.id}/objects/${object.id}`, { hidden }), { name: object.name });
  }

  // List a new, changed or renamed selection.
  setSelection(selection) {
    this.setObjects(this.items, [selection, ...this.selections.filter(({ id }) => id !== selection.id)]);
    this.render();
  }

  get route() {
    return `/lifts/${this.lift.id}/selections`;
  }

  // The sets of a ZIP of all objects: visible objects and selections.
  exportedSets() {
    return [...this.selections.map(({ id, name }) => ({ sets: [`selection:${id}`], name })),
      ...this.items.filter(object => !object.hidden && !this.isBackground(object)).map(object => ({ sets: [term(object)], name: object.title }))];
  }

  toggleSet(set, extend) {
    const sets = extend ? this.selectedSets().filter(term => /^(object|selection):/.test(term)) : [];
    this.selectSets(sets.includes(set) ? sets.filter(term => term !== set) : [...sets, set]);
  }

  // Select the object at an example; if it is selected, its part there, and so on down to the smallest. False if there is
  // no object or the smallest is selected: then the click is an example.
  async selectAt(example, extend) {
    if (!this.items.length) return false;
    try {
      const { candidates } = await fetchJson(`/query?${queryString({ lift: this.lift.id, like: example, top: 0 })}`);
      const nested = candidates.filter(candidate => candidate.kind !== "group" && !this.isBackground(candidate)).reverse(); // largest first
      if (!nested.length) return false;
      nested.unshift(...await this.replacementAt(example, nested));
      const selected = this.selectedSets();
      const position = extend || selected.length !== 1 ? -1 : nested.findIndex(candidate => candidate.set === selected[0]);
      if (position === nested.length - 1) return false;
      const next = nested[position + 1];
      for (const { id } of nested.slice(0, position + 1)) if (id !== undefined) this.openNodes.add(id);
      this.toggleSet(next.set, extend);
      return true;
    } catch (problem) {
      notify(problemText(problem), true);
      return true;
    }
  }

  // The selection that replaces a hidden object at an example, such as a join or a side of a split; [] if there is none.
  async replacementAt(example, nested) {
    const hidden = this.items.filter(object => object.hidden).map(term);
    const hiddenSets = nested.map(({ set }) => set).filter(set => hidden.includes(set));
    if (!hiddenSets.length) return [];
    const details = await Promise.all(this.selections.map(({ id }) => this.readSelection(id)));
    const descends = ({ history }) => sourceSets(history).some(set => hiddenSets.includes(set) || details.some(detail => set === `selection:${detail.id}` && descends(detail)));
    const descendants = details.filter(descends);
    const splat = /^splat:(\d+)$/.exec(example);
    for (const detail of descendants) {
      const set = `selection:${detail.id}`;
      if (splat ? isSelected(detail.bits, Number(splat[1])) : descendants.length === 1 || await this.isInMask(set, example)) return [{ set }];
    }
    return [];
  }

  // True if the mask of a set in a view covers the pixel of an example.
  async isInMask(set, example) {
    const [, view, x, y] = /^(.*):(\d+),(\d+)$/.exec(example) ?? [];
    if (view === undefined) return false;
    const context = Object.assign(document.createElement("canvas"), { width: 1, height: 1 }).getContext("2d");
    const mask = await fetchPicture(`/query/mask?${queryString({ lift: this.lift.id, sets: set, view })}`);
    context.drawImage(mask, -x, -y);
    URL.revokeObjectURL(mask.src);
    return context.getImageData(0, 0, 1, 1).data[0] > 127;
  }

  editName(object, item) {
    const input = el("input", { type: "text", className: "name", value: object.name || "", maxLength: 100, "aria-label": `Name of ${object.title}`,
      on: { change: () => this.changeObject(object, { name: input.value.trim() || null }), keydown: event => event.key === "Escape" && this.render(), blur: () => this.render() } });
    item.replaceChildren(input);
    input.focus();
  }

  async changeObject(object, change) {
    try {
      const { name, hidden } = await patch(`/lifts/${this.lift.id}/objects/${object.id}`, change);
      Object.assign(object, { hidden, ...("name" in change && { name }) });
      if (change.name === null) return await this.setLift(this.lift);
      this.setObjects(this.items);
    } catch (problem) { notify(problemText(problem), true); }
    return this.render();
  }
}

// The first objects of a lift, their total, and the query of the encoder that named them.
async function fetchObjects(lift) {
  const route = `/lifts/${lift.id}/objects?limit=${MAX_OBJECTS}`;
  let encoderQuery = lift.text_space === "none" ? "" : `&encoder=${encodeURIComponent(lift.text_space)}`;
  const { objects, count: total } = await fetchJson(route + encoderQuery).catch(() => { encoderQuery = ""; return fetchJson(route); }); // this text space has no table of words
  return { objects, encoderQuery, total };
}

// Give objects titles; those of one name are numbered.
function titleObjects(objects) {
  const totals = new Map();
  for (const { name } of objects) totals.set(name, (totals.get(name) || 0) + 1);
  const counts = new Map();
  for (const object of objects) {
    const number = (counts.get(object.name) || 0) + 1;
    counts.set(object.name, number);
    object.title = !object.name ? `Object ${object.id + 1}` : totals.get(object.name) > 1 ? `${object.name} ${number}` : object.name;
  }
}

// Fetch the titles of sets of a lift: a Map by terms.
export async function fetchTitles(lift, sets) {
  const titles = new Map();
  const selections = sets.filter(set => set.startsWith("selection:"));
  await Promise.all(selections.map(async set => titles.set(set, (await fetchJson(`/lifts/${lift.id}/selections/${set.slice(10)}`)).name)));
  if (selections.length === sets.length) return titles;
  const { objects } = await fetchObjects(lift);
  titleObjects(objects);
  for (const object of objects) titles.set(term(object), object.title);
  return titles;
}

// The sets of the first edit of a selection.
const sourceSets = history => history?.[0]?.edit.query?.sets ?? [];

// True if a splat is in the bits of a selection: base64, the lowest bit of a byte first.
const isSelected = (bits, splat) => atob(bits).charCodeAt(splat >> 3) >> (splat & 7) & 1;

// The object that a selection was made of, in a list; [] if it is not one object.
export const sourceObject = ({ history }) => {
  const sets = sourceSets(history);
  return sets.length === 1 && sets[0].startsWith("object:") ? sets : [];
};
const term = object => `object:${object.id}`;
