// The list of lifts, with buttons to open and delete them.
import { ago, byId, formatCount, el, notify, confirmButton } from "./dom.js";
import { patch, remove, problemText } from "./service.js";

export const liftTitle = lift => lift.name || `Scene without a name, ${ago(lift.created)}`;

const SPACES = { none: "no text encoder", prompts: "prompts of the lift", "": "unknown text encoder" };
export const textSpaceLabel = ({ text_space: name }) => SPACES[name] || "text queries";

export class LiftList {
  // onOpen(id): open a lift. onChange(): a lift was named or deleted.
  constructor({ onOpen, onChange }) {
    Object.assign(this, { onOpen, onChange });
  }

  render(lifts, openId) {
    byId("lifts-head").hidden = !lifts.length;
    byId("lifts").replaceChildren(...lifts.map(lift => el("li", { className: lift.id === openId ? "now" : "" },
      el("span", { className: "name" }, liftTitle(lift)),
      el("span", { className: "state" }, `${formatCount(lift.count)} splats \u00b7 ${lift.view_count} views \u00b7 ${textSpaceLabel(lift)} \u00b7 ${ago(lift.created)}`),
      el("span", { className: "actions" },
        lift.id === openId ? el("span", { className: "quiet" }, "Open") : el("button", { type: "button", on: { click: () => this.onOpen(lift.id) } }, "Open"),
        confirmButton("Delete", () => remove(`/jobs/${lift.id}?with_lift=true`).then(() => this.onChange()))))));
  }

  async renameLift(lift, name) {
    try {
      Object.assign(lift, await patch(`/lifts/${lift.id}`, { name: name || null }));
      this.onChange();
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }
}
