// The list of lifts: names that people give, what to open, what to delete.
import { ago, at, count, el, notify, twice } from "./dom.js";
import { named } from "./files.js";
import { patch, remove, words } from "./service.js";

export const title = lift => lift.name || `${named(lift.id) ?? `${count(lift.count)} splats`}, ${ago(lift.created)}`;

const SPACES = { none: "no words", prompts: "own words", "": "words of no known encoder" };
export const space = ({ text_space: name }) => SPACES[name] || "asked in words";

export class Lifts {
  // opened: with the lift to show; beside: with one to see beside what is open; changed: after one was named or deleted.
  constructor({ opened, beside, changed }) {
    Object.assign(this, { opened, beside, changed });
  }

  show(lifts, open) {
    const snapshot = JSON.stringify([lifts.map(({ id, name }) => [id, name]), open]);
    if (snapshot === this.snapshot) return; // a name that is being written stays
    this.snapshot = snapshot;
    at("lifts-head").hidden = !lifts.length;
    at("lifts").replaceChildren(...lifts.map(lift => el("li", { className: lift.id === open ? "now" : "" },
      el("input", { type: "text", className: "name", value: lift.name || "", maxLength: 100, placeholder: "Give it a name", "aria-label": `Name of the lift of ${ago(lift.created)}`,
        on: { change: event => this.name(lift, event.target.value.trim()) } }),
      el("span", { className: "state" }, `${count(lift.count)} splats \u00b7 ${lift.view_count} views \u00b7 ${space(lift)} \u00b7 ${ago(lift.created)}`),
      el("span", { className: "actions" },
        lift.id === open ? el("span", { className: "quiet" }, "Open") : el("button", { type: "button", on: { click: () => this.opened(lift.id) } }, "Open"),
        open && lift.id !== open ? el("button", { type: "button", className: "only-3d", "aria-label": `Compare with the lift of ${ago(lift.created)}`, on: { click: () => this.beside(lift.id) } }, "Compare") : null,
        twice("Delete", () => remove(`/jobs/${lift.id}?with_lift=true`).then(() => this.changed()))))));
  }

  async name(lift, name) {
    try {
      Object.assign(lift, await patch(`/lifts/${lift.id}`, { name: name || null }));
      this.changed();
    } catch (problem) {
      notify(words(problem), true);
    }
  }
}
