// Editing of a selection with a brush or a box, in 3D and in the photo view.
import { byId, el, plural, notify } from "./dom.js";
import { call, fetchJson, patch, post, problemText } from "./service.js";

const TERM = /^selection:([0-9a-f]{16})$/;
const MAX_CAMERA_WIDTH = 960; // pixels of the camera of a stroke in 3D
const MAX_CORNERS = 250; // points of a stroke
const BRUSH_RADIUS = 14; // CSS pixels, at first
const SVG = "http://www.w3.org/2000/svg";

export class SelectionEditor {
  // query: the QueryPanel. questionLabel(question): its text. viewer(): the 3D view, or null. layers: the LayerPanel with
  // the photo view. objects: the ObjectList.
  constructor({ query, questionLabel, viewer, layers, objects }) {
    Object.assign(this, { query, questionLabel, viewer, layers, objects, tool: null, removes: false, selection: null, brushRadius: BRUSH_RADIUS });
    this.build();
    this.listenTo(byId("scene"), () => this.areaIn3d());
    this.listenTo(byId("picture"), () => this.areaInView());
    byId("by-hand").addEventListener("click", () => (this.selection ? this.setOpen(true) : this.createSelection()));
  }

  build() {
    const button = (text, onClick, attributes = {}) => el("button", { type: "button", ...attributes, on: { click: onClick } }, text);
    this.toolButtons = { brush: button("Brush", () => this.setTool("brush")), box: button("Box", () => this.setTool("box")) };
    this.sideButtons = [false, true].map(removes => button(removes ? "Remove" : "Add", () => { this.removes = removes; this.render(); }));
    this.stepButtons = { undo: button("Undo", () => this.step(-1), { title: "Ctrl+Z" }), redo: button("Redo", () => this.step(1), { title: "Ctrl+Shift+Z" }) };
    const size = el("input", { type: "range", min: 3, max: 60, value: BRUSH_RADIUS, ariaLabel: "Size of the brush", on: { input: event => { this.brushRadius = Number(event.target.value); } } });
    this.throughBox = el("input", { type: "checkbox" });
    this.nameField = el("input", { type: "text", className: "name", maxLength: 100, ariaLabel: "Name of the selection", on: { change: () => this.rename() } });
    const group = (name, ...parts) => el("span", { className: "row", role: "group", ariaLabel: name }, ...parts);
    byId("hand").append(this.nameField, group("Tool", ...Object.values(this.toolButtons), size), group("Operation", ...this.sideButtons),
      el("label", { title: "Also select the splats behind" }, this.throughBox, " through"),
      group("Grow or shrink by neighbouring splats", button("Grow", () => this.edit({ operation: "grow" })), button("Shrink", () => this.edit({ operation: "shrink" }))),
      group("History", ...Object.values(this.stepButtons)), button("Done", () => this.setOpen(false)));
    this.strokeDrawing = document.createElementNS(SVG, "svg");
    this.strokeDrawing.id = "stroke";
    byId("stage").append(this.strokeDrawing);
  }

  // After each change of the questions: load their selection, if they are one.
  async followQuestion() {
    const id = TERM.exec(this.query.current?.sets.length === 1 ? this.query.current.sets[0] : "")?.[1];
    if (!id) { this.selection = null; this.setOpen(false); return; }
    if (this.selection?.id === id) return;
    this.selection = { id };
    this.setOpen(true);
    try {
      const selection = await fetchJson(`/lifts/${this.query.lift.id}/selections/${id}`);
      if (this.selection?.id === id) this.setSelection(selection);
    } catch (problem) { notify(problemText(problem), true); }
  }

  setSelection(selection) {
    this.selection = selection;
    this.objects.setSelection(selection);
    this.render();
  }

  // Show the bar of tools, or the button that opens it again.
  setOpen(isOpen) {
    byId("hand").hidden = !isOpen;
    byId("by-hand").hidden = isOpen || !this.query.current?.answer;
    if (!isOpen && this.tool) this.setTool(null);
  }

  // Make a selection of the current question.
  async createSelection() {
    const { current: now } = this.query;
    if (!now?.answer) return;
    const { lift, ...query } = this.query.requestBody(now);
    try {
      this.setSelection(await post(`/lifts/${lift}/selections`, { name: `${this.questionLabel(now).slice(0, 90)} by hand`, edit: { operation: "set", query } }));
      this.setOpen(true);
      this.setTool("brush");
      await this.query.askSets([`selection:${this.selection.id}`]);
    } catch (problem) { notify(problemText(problem), true); }
  }

  get route() {
    return `/lifts/${this.query.lift.id}/selections/${this.selection.id}`;
  }

  async change(action) {
    if (!this.selection?.version || this.isBusy) return;
    this.isBusy = true;
    byId("stage").classList.add("asking");
    try {
      this.setSelection(await action({ "If-Match": `"${this.selection.version}"` }));
      await this.query.ask(this.query.current);
    } catch (problem) {
      notify(problem.status === 412 ? "The selection was changed elsewhere. The newest version is shown." : problemText(problem), true);
      if (problem.status === 412) { this.selection = null; await this.followQuestion(); await this.query.ask(this.query.current); }
    } finally {
      this.isBusy = false;
      byId("stage").classList.remove("asking");
      this.strokeDrawing.replaceChildren();
    }
  }

  edit(edit) {
    return this.change(match => post(`${this.route}/edits`, edit, match));
  }

  goToStep(step) {
    return this.change(async headers => (await call(this.route, { method: "PATCH", body: { step }, extraHeaders: headers })).json());
  }

  // Undo or redo by one step. False if there is none.
  step(offset) {
    const { selection } = this;
    if (!selection?.version || selection.step + offset < selection.first || selection.step + offset > selection.last) return false;
    this.goToStep(selection.step + offset);
    return true;
  }

  async rename() {
    const name = this.nameField.value.trim();
    if (!name || !this.selection) return;
    try {
      this.setSelection(await patch(this.route, { name }));
      this.query.render();
      this.query.onChange();
    } catch (problem) { notify(problemText(problem), true); }
  }

  link(parameters) {
    if (this.selection?.version) parameters.set("step", this.selection.step);
  }

  // Open the step of a link, if the selection still has it.
  async restore(parameters) {
    await this.followQuestion();
    const step = Number(parameters.get("step") ?? NaN);
    const { selection } = this;
    if (selection?.version && step !== selection.step && step >= selection.first && step <= selection.last) await this.goToStep(step);
  }

  setTool(tool) {
    this.tool = tool === this.tool ? null : tool;
    this.render();
  }

  render() {
    for (const [name, button] of Object.entries(this.toolButtons)) button.setAttribute("aria-pressed", String(name === this.tool));
    this.sideButtons.forEach((button, index) => button.setAttribute("aria-pressed", String(Boolean(index) === this.removes)));
    const { selection } = this;
    if (selection?.version) {
      this.nameField.value = selection.name;
      this.nameField.title = plural(selection.count, "splat");
      this.stepButtons.undo.disabled = selection.step <= selection.first;
      this.stepButtons.redo.disabled = selection.step >= selection.last;
    }
    byId("stage").classList.toggle("by-hand", Boolean(this.tool));
  }

  // The area of a stroke in 3D: the camera, the element and camera pixels per CSS pixel.
  areaIn3d() {
    const camera = this.viewer()?.cameraRequest(MAX_CAMERA_WIDTH);
    return camera && { camera, view: "camera", element: byId("scene"), scale: camera.width / byId("scene").clientWidth };
  }

  areaInView() {
    const element = byId("render");
    return { view: this.layers.view.name, element, scale: element.naturalWidth / element.getBoundingClientRect().width };
  }

  // Handle pointer events before the camera's controls and the boxes of examples while a tool is active.
  listenTo(element, locate) {
    const consume = event => { event.stopImmediatePropagation(); event.preventDefault(); };
    element.addEventListener("pointerdown", event => {
      if (!this.tool || event.button !== 0 || !event.isPrimary) return;
      consume(event);
      const area = locate();
      if (!area || this.isBusy) return;
      this.stroke = { ...area, points: [this.pointIn(event, area)], removes: this.removes !== event.altKey };
      element.setPointerCapture(event.pointerId);
      this.draw();
    }, true);
    element.addEventListener("pointermove", event => {
      if (!this.stroke) return;
      consume(event);
      this.stroke.points.push(this.pointIn(event, this.stroke));
      this.draw();
    }, true);
    for (const end of ["pointerup", "pointercancel"]) {
      element.addEventListener(end, event => {
        if (!this.stroke) return;
        consume(event);
        const { stroke } = this;
        this.stroke = null;
        if (end === "pointerup") this.applyStroke(stroke); else this.strokeDrawing.replaceChildren();
      }, true);
    }
    element.addEventListener("click", event => { if (this.tool) consume(event); }, true);
  }

  pointIn({ clientX, clientY }, { element }) {
    const { left, top } = element.getBoundingClientRect();
    return [clientX - left, clientY - top];
  }

  draw() {
    const { points, element, removes } = this.stroke;
    const stage = byId("stage").getBoundingClientRect();
    const { left, top } = element.getBoundingClientRect();
    const corners = points.map(([x, y]) => [x + left - stage.left, y + top - stage.top]);
    const shape = document.createElementNS(SVG, this.tool === "box" ? "rect" : "polyline");
    const [[x0, y0], [x1, y1]] = [corners[0], corners.at(-1)];
    const attributes = this.tool === "box"
      ? { x: Math.min(x0, x1), y: Math.min(y0, y1), width: Math.abs(x1 - x0), height: Math.abs(y1 - y0) }
      : { points: [...corners, corners.at(-1)].join(" "), "stroke-width": 2 * this.brushRadius };
    for (const [name, value] of Object.entries({ ...attributes, class: removes ? "less" : "" })) shape.setAttribute(name, value);
    this.strokeDrawing.replaceChildren(shape);
  }

  applyStroke({ points, scale, view, camera, removes }) {
    const step = Math.ceil(points.length / MAX_CORNERS);
    const pixels = points.filter((_, index) => index % step === 0 || index === points.length - 1).map(([x, y]) => [Math.round(x * scale), Math.round(y * scale)]);
    const [first, last] = [pixels[0], pixels.at(-1)];
    const [low, high] = [0, 1].map(end => [0, 1].map(axis => Math.max(0, Math[end ? "max" : "min"](first[axis], last[axis]) + end)));
    const corners = this.tool === "box" ? [low, high] : pixels.length > 1 ? pixels : [first, first];
    this.edit({
      operation: removes ? "remove" : "add", area: `${view}:${this.tool === "box" ? "box" : "stroke"}:${corners.flat()}`,
      radius: Math.max(1, this.brushRadius * scale), through: this.throughBox.checked, ...(camera && { camera }),
    });
  }
}
