// Correcting by hand: a brush and a box that add to a selection or take away, in 3D and in the photo's view.
import { at, el, plural, notify } from "./dom.js";
import { wholeOf } from "./things.js";
import { call, json, patch, post, words } from "./service.js";

const TERM = /^selection:([0-9a-f]{16})$/;
const MOST = 960; // pixels of the camera of a stroke in 3D, across
const CORNERS = 250; // of a stroke
const SIZE = 14; // CSS pixels of the brush, from its middle, at first
const SVG = "http://www.w3.org/2000/svg";

export class Hand {
  // ask: the questions; label: of one; viewer: gives the 3D view, or null; look: the photo's view; things: the scene's.
  constructor({ ask, label, viewer, look, things }) {
    Object.assign(this, { ask, label, viewer, look, things, tool: null, less: false, selection: null, size: SIZE });
    this.build();
    this.listen(at("scene"), () => this.in3d());
    this.listen(at("picture"), () => this.inView());
    at("by-hand").addEventListener("click", () => this.begin());
  }

  build() {
    const button = (text, press, more = {}) => el("button", { type: "button", ...more, on: { click: press } }, text);
    this.tools = { brush: button("Brush", () => this.take("brush")), box: button("Box", () => this.take("box")) };
    this.sides = [false, true].map(less => button(less ? "Take away" : "Add", () => { this.less = less; this.show(); }));
    this.steps = { undo: button("Undo", () => this.go(-1), { title: "Ctrl+Z" }), redo: button("Redo", () => this.go(1), { title: "Ctrl+Shift+Z" }) };
    const size = el("input", { type: "range", min: 3, max: 60, value: SIZE, ariaLabel: "Size of the brush", on: { input: event => { this.size = Number(event.target.value); } } });
    this.splitting = button("Split", () => this.things.split(this.selection), { title: "The rest of the thing becomes one of its own" });
    this.through = el("input", { type: "checkbox" });
    this.name = el("input", { type: "text", className: "name", maxLength: 100, ariaLabel: "Name of the selection", on: { change: () => this.rename() } });
    const group = (name, ...parts) => el("span", { className: "row", role: "group", ariaLabel: name }, ...parts);
    at("hand").append(this.name, group("Tool", ...Object.values(this.tools), size), group("What it does", ...this.sides),
      el("label", { title: "Also what lies behind" }, this.through, " through"),
      group("By splats that touch", button("Grow", () => this.edit({ operation: "grow" })), button("Shrink", () => this.edit({ operation: "shrink" }))),
      this.splitting, group("History", ...Object.values(this.steps)), button("Done", () => { this.take(null); at("hand").hidden = true; }));
    this.drawn = document.createElementNS(SVG, "svg");
    this.drawn.id = "stroke";
    at("stage").append(this.drawn);
  }

  // The selection that is asked for, if one is; after each change of the questions.
  async follow() {
    const id = TERM.exec(this.ask.now?.sets.length === 1 ? this.ask.now.sets[0] : "")?.[1];
    at("by-hand").hidden = Boolean(id) || !this.ask.now?.answer;
    if (!id) { this.selection = null; this.take(null); at("hand").hidden = true; return; }
    if (this.selection?.id === id) return;
    this.selection = { id };
    try {
      const found = await json(`/lifts/${this.ask.lift.id}/selections/${id}`);
      if (this.selection?.id === id) this.have(found);
    } catch (problem) { notify(words(problem), true); }
  }

  have(selection) {
    this.selection = selection;
    this.things.changed(selection);
    at("hand").hidden = false;
    this.show();
  }

  // What is asked becomes a selection of its own.
  async begin() {
    const { now } = this.ask;
    if (!now?.answer) return;
    const { lift, ...query } = this.ask.body(now);
    try {
      this.have(await post(`/lifts/${lift}/selections`, { name: this.label(now).slice(0, 100), edit: { operation: "set", query } }));
      this.take("brush");
      await this.ask.hold([`selection:${this.selection.id}`]);
    } catch (problem) { notify(words(problem), true); }
  }

  get route() {
    return `/lifts/${this.ask.lift.id}/selections/${this.selection.id}`;
  }

  async change(action) {
    if (!this.selection?.version || this.busy) return;
    this.busy = true;
    at("stage").classList.add("asking");
    try {
      this.have(await action({ "If-Match": `"${this.selection.version}"` }));
      await this.ask.ask(this.ask.now);
    } catch (problem) {
      notify(problem.status === 412 ? "Somebody else changed it meanwhile: this is what it is now." : words(problem), true);
      if (problem.status === 412) { this.selection = null; await this.follow(); await this.ask.ask(this.ask.now); }
    } finally {
      this.busy = false;
      at("stage").classList.remove("asking");
      this.drawn.replaceChildren();
    }
  }

  edit(edit) {
    return this.change(match => post(`${this.route}/edits`, edit, match));
  }

  to(step) {
    return this.change(async more => (await call(this.route, { method: "PATCH", body: { step }, more })).json());
  }

  // Undo and redo; whether there was a step to go.
  go(by) {
    const { selection } = this;
    if (!selection?.version || selection.step + by < selection.first || selection.step + by > selection.last) return false;
    this.to(selection.step + by);
    return true;
  }

  async rename() {
    const name = this.name.value.trim();
    if (!name || !this.selection) return;
    try {
      this.have(await patch(this.route, { name }));
      this.ask.show();
      this.ask.changed();
    } catch (problem) { notify(words(problem), true); }
  }

  link(parameters) {
    if (this.selection?.version) parameters.set("step", this.selection.step);
  }

  // From a link: the selection as it was at that step, if it still has it.
  async restore(parameters) {
    await this.follow();
    const step = Number(parameters.get("step") ?? NaN);
    const { selection } = this;
    if (selection?.version && step !== selection.step && step >= selection.first && step <= selection.last) await this.to(step);
  }

  take(tool) {
    this.tool = tool === this.tool ? null : tool;
    this.show();
  }

  show() {
    for (const [name, button] of Object.entries(this.tools)) button.setAttribute("aria-pressed", String(name === this.tool));
    this.sides.forEach((button, place) => button.setAttribute("aria-pressed", String(Boolean(place) === this.less)));
    const { selection } = this;
    if (selection?.version) {
      this.name.value = selection.name;
      this.splitting.hidden = !wholeOf(selection).length || selection.step === selection.first;
      this.name.title = plural(selection.count, "splat");
      this.steps.undo.disabled = selection.step <= selection.first;
      this.steps.redo.disabled = selection.step >= selection.last;
    }
    at("stage").classList.toggle("by-hand", Boolean(this.tool));
  }

  // Where a stroke is in 3D: the camera of the screen, and pixels of it for one of the page.
  in3d() {
    const camera = this.viewer()?.own(MOST);
    return camera && { camera, view: "camera", element: at("scene"), scale: camera.width / at("scene").clientWidth };
  }

  inView() {
    const element = at("render");
    return { view: this.look.view.name, element, scale: element.naturalWidth / element.getBoundingClientRect().width };
  }

  // Before the camera's controls, and before the boxes of examples, where a tool is taken.
  listen(element, where) {
    const mine = event => { event.stopImmediatePropagation(); event.preventDefault(); };
    element.addEventListener("pointerdown", event => {
      if (!this.tool || event.button !== 0 || !event.isPrimary) return;
      mine(event);
      const place = where();
      if (!place || this.busy) return;
      this.stroke = { ...place, points: [this.point(event, place)], less: this.less !== event.altKey };
      element.setPointerCapture(event.pointerId);
      this.draw();
    }, true);
    element.addEventListener("pointermove", event => {
      if (!this.stroke) return;
      mine(event);
      this.stroke.points.push(this.point(event, this.stroke));
      this.draw();
    }, true);
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, event => {
        if (!this.stroke) return;
        mine(event);
        const { stroke } = this;
        this.stroke = null;
        if (end === "pointerup") this.pass(stroke); else this.drawn.replaceChildren();
      }, true);
    }
    element.addEventListener("click", event => { if (this.tool) mine(event); }, true);
  }

  point({ clientX, clientY }, { element }) {
    const { left, top } = element.getBoundingClientRect();
    return [clientX - left, clientY - top];
  }

  draw() {
    const { points, element, less } = this.stroke;
    const stage = at("stage").getBoundingClientRect();
    const { left, top } = element.getBoundingClientRect();
    const shown = points.map(([x, y]) => [x + left - stage.left, y + top - stage.top]);
    const shape = document.createElementNS(SVG, this.tool === "box" ? "rect" : "polyline");
    const [[x0, y0], [x1, y1]] = [shown[0], shown.at(-1)];
    const values = this.tool === "box"
      ? { x: Math.min(x0, x1), y: Math.min(y0, y1), width: Math.abs(x1 - x0), height: Math.abs(y1 - y0) }
      : { points: [...shown, shown.at(-1)].join(" "), "stroke-width": 2 * this.size };
    for (const [name, value] of Object.entries({ ...values, class: less ? "less" : "" })) shape.setAttribute(name, value);
    this.drawn.replaceChildren(shape);
  }

  pass({ points, scale, view, camera, less }) {
    const step = Math.ceil(points.length / CORNERS);
    const some = points.filter((_, place) => place % step === 0 || place === points.length - 1).map(([x, y]) => [Math.round(x * scale), Math.round(y * scale)]);
    const [first, last] = [some[0], some.at(-1)];
    const [low, high] = [0, 1].map(end => [0, 1].map(axis => Math.max(0, Math[end ? "max" : "min"](first[axis], last[axis]) + end)));
    const corners = this.tool === "box" ? [low, high] : some.length > 1 ? some : [first, first];
    this.edit({
      operation: less ? "remove" : "add", area: `${view}:${this.tool === "box" ? "box" : "stroke"}:${corners.flat()}`,
      radius: Math.max(1, this.size * scale), through: this.through.checked, ...(camera && { camera }),
    });
  }
}
