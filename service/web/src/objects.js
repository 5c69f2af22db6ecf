// The list of objects that the lift made of its masks, with their parts, and of selections; a click selects one of them.
import { byId, formatCount, el, plural, notify, confirmButton } from "./dom.js";
import { queryString } from "./question.js";
import { fetchBytes, fetchJson, patch, readNpy, remove, problemText } from "./service.js";

const MAX_OBJECTS = 100; // objects of the list
const MAX_NODES = 1000; // objects and parts of the tree
const SAME_SHARE = 0.8; // of the splats of an object or its word: with more in both, the word answers for the object
const BACKGROUND_SHARE = 0.5; // of the scene's splats: an object with more of them is background

export class ObjectList {
  // selectSets(terms, word), selectedSets(): the sets of the current question; the word answers for them, if there is one. flyToBox(box, view): move the camera; the view
  // shows most of the box. namesByTerm: a Map of names of objects and selections. onHide(splats): hidden splats changed.
  constructor({ selectSets, selectedSets, flyToBox, namesByTerm, onHide }) {
    Object.assign(this, { selectSets, selectedSets, flyToBox, namesByTerm, onHide, items: [], selections: [], nodes: new Map(), openNodes: new Set() });
    byId("scene-objects-hidden").addEventListener("click", () => { this.showsHidden = !this.showsHidden; this.render(); });
  }

  async setLift(lift) {
    Object.assign(this, { lift, items: [], selections: [], nodes: new Map(), openNodes: new Set(), showsHidden: false });
    byId("scene-objects-most").textContent = "";
    this.render();
    if (lift) fetchJson(`/lifts/${lift.id}/selections`).then(({ selections }) => { if (lift === this.lift) this.setObjects(this.items, selections); }).then(() => this.render(), () => {});
    if (!lift?.links.objects) return; // old lifts have no objects
    try {
      const { objects, encoderQuery, total } = await fetchObjects(lift);
      if (lift === this.lift) this.setObjects(objects);
      this.hideSplats();
      if (lift === this.lift && total > objects.length) byId("scene-objects-most").textContent = `The first ${formatCount(objects.length)} of ${formatCount(total)} objects. Click in the scene to select others.`;
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

  // The names that people gave to objects and selections: {word, term}.
  ownNames() {
    return [...this.items.filter(({ name, score }) => name && score === null).map(object => ({ word: object.name, term: term(object) })),
      ...this.selections.map(({ id, name }) => ({ word: name, term: `selection:${id}` }))];
  }

  // Fetch which splats are hidden.
  async hideSplats() {
    const { lift } = this;
    const sets = this.items.filter(({ hidden }) => hidden).map(term);
    try {
      const splats = sets.length ? readNpy(await fetchBytes(`/query/selection?${queryString({ lift: lift.id, sets })}`)) : null;
      if (lift === this.lift) this.onHide(splats);
    } catch (problem) { notify(problemText(problem), true); }
  }

  // Number the parts of an object.
  titleParts(object) {
    this.parts(object).forEach((part, index) => {
      part.title = `Part ${index + 1}`;
      this.namesByTerm.set(term(part), `part ${index + 1} of the ${this.namesByTerm.get(term(object))}`);
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
    byId("scene-objects").hidden = !this.items.length && !this.selections.length;
    byId("scene-objects-own").replaceChildren(...this.selections.map(selection => el("li", {},
      el("button", { type: "button", className: "object", "aria-pressed": String(selected.includes(`selection:${selection.id}`)), on: { click: event => this.selectSelection(selection, event.shiftKey) } },
        el("span", {}, selection.name, el("small", {}, `${plural(selection.count, "splat")}, selection`))),
      confirmButton("Delete", () => this.deleteSelection(selection.id)))));
    byId("scene-objects-hidden").hidden = !hidden;
    byId("scene-objects-hidden").textContent = this.showsHidden ? "Hide the hidden objects" : `Show ${plural(hidden, "hidden object")}`;
    const focusedId = document.activeElement?.dataset.unfolds; // the button is replaced
    byId("scene-objects-list").replaceChildren(...visible.map(object => el("li", { className: object.hidden ? "hidden-object" : "" }, ...this.objectButtons(object, selected),
      el("button", { type: "button", className: "plain edit", title: "Name this object", "aria-label": `Name ${object.title}`, on: { click: event => this.editName(object, event.target.closest("li")) } }, "\u270e"),
      el("button", { type: "button", className: "plain edit", "aria-label": `${object.hidden ? "Show" : "Hide"} ${object.title}`, on: { click: () => this.changeObject(object, { hidden: !object.hidden }) } }, object.hidden ? "Show" : "Hide"),
      ...this.partList(object, selected))));
    if (focusedId) byId("scene-objects-list").querySelector(`[data-unfolds="${focusedId}"]`)?.focus();
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

  async deleteSelection(id) {
    await remove(`${this.route}/${id}`);
    this.setObjects(this.items, this.selections.filter(selection => selection.id !== id));
    const set = `selection:${id}`;
    if (this.selectedSets().includes(set)) this.toggleSet(set, true); else this.render();
  }

  // List a new, changed or renamed selection.
  setSelection(selection) {
    this.setObjects(this.items, [selection, ...this.selections.filter(({ id }) => id !== selection.id)]);
    this.render();
  }

  get route() {
    return `/lifts/${this.lift.id}/selections`;
  }

  // The sets of a file of all objects: visible objects and selections.
  exportedSets() {
    return [...this.selections.map(({ id, name }) => ({ sets: [`selection:${id}`], name })),
      ...this.items.filter(object => !object.hidden && !this.isBackground(object)).map(object => ({ sets: [term(object)], name: object.title }))];
  }

  async toggleSet(set, extend) {
    const sets = extend ? this.selectedSets().filter(term => /^(object|selection):/.test(term)) : [];
    const newSets = sets.includes(set) ? sets.filter(term => term !== set) : [...sets, set];
    this.selectSets(newSets, newSets.length === 1 ? await this.wordOf(newSets[0]) : null);
  }

  // The word of an object if it selects about the same splats: edges of masks leave strays in objects. Else null.
  async wordOf(set) {
    const { items, lift } = this;
    const object = items.find(item => term(item) === set);
    if (!object || object.score === null || items.filter(({ name }) => name === object.name).length > 1) return null;
    try {
      const fields = [{ sets: set }, { text: object.name }].map(field => queryString({ lift: lift.id, ...field }));
      const [own, ofWord] = (await Promise.all(fields.map(field => fetchBytes(`/query/selection?${field}`)))).map(readNpy);
      const both = own.filter((isSelected, splat) => isSelected && ofWord[splat]).length;
      const either = own.filter((isSelected, splat) => isSelected || ofWord[splat]).length;
      return both > SAME_SHARE * either ? object.name : null;
    } catch { return null; }
  }

  // Select the object at an example; if it is selected, its part there, and so on down to the smallest. False if there is
  // no object or the smallest is selected: then the click is an example.
  async selectAt(example, extend) {
    if (!this.items.length) return false;
    try {
      const { candidates } = await fetchJson(`/query?${queryString({ lift: this.lift.id, like: example, top: 0 })}`);
      const nested = candidates.filter(candidate => candidate.kind !== "group" && !this.isBackground(candidate)).reverse(); // largest first
      if (!nested.length) return false;
      if (this.items.some(object => object.hidden && term(object) === nested[0].set)) { notify("This object is hidden."); return true; }
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

  editName(object, item) {
    const input = el("input", { type: "text", className: "name", value: object.name || "", maxLength: 100, "aria-label": `Name of ${object.title}`,
      on: { change: () => this.changeObject(object, { name: input.value.trim() || null }), keydown: event => event.key === "Escape" && this.render(), blur: () => this.render() } });
    item.replaceChildren(input);
    input.focus();
  }

  async changeObject(object, change) {
    try {
      const { name, hidden } = await patch(`/lifts/${this.lift.id}/objects/${object.id}`, change);
      Object.assign(object, { hidden, ...("name" in change && { name, score: null }) });
      if (change.name === null) return await this.setLift(this.lift);
      if ("hidden" in change) await this.hideSplats();
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

const term = object => `object:${object.id}`;
