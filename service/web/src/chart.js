// A comparison of settings: the service's chart, and its runs; a click opens the lift of one.
import { byId, formatCount, el, plural, notify } from "./dom.js";
import { download, fetchJson, fetchPicture, post, problemText } from "./service.js";

const PAGE_SIZE = 100; // lifts that are searched for one with the same settings

export class Chart {
  // onOpen(id): open a lift. onOrder(job, name): follow the job of a new one.
  constructor({ onOpen, onOrder }) {
    Object.assign(this, { onOpen, onOrder });
    byId("chart-picture").addEventListener("click", () => download(`/tradeoffs/${this.tradeoff.id}/chart`, "speed-against-accuracy.png", undefined, true).catch(problem => notify(problemText(problem), true)));
  }

  async show(id) {
    const [tradeoff, picture] = await Promise.all([fetchJson(`/tradeoffs/${id}`), fetchPicture(`/tradeoffs/${id}/chart`)]);
    const { choice, runs, views } = this.tradeoff = tradeoff;
    byId("chart-title").textContent = choice.recommended ? `Recommended: \u201c${choice.name}\u201d` : "No run is recommended";
    byId("chart-why").textContent = `${choice.why[0].toUpperCase()}${choice.why.slice(1)}. ${plural(views.lifted, "view")} of ${formatCount(views.of)} lifted, ${formatCount(views.held_out)} held out for evaluation.`;
    picture.alt = "Accuracy of each run over its seconds";
    byId("chart-plot").replaceChildren(picture);
    byId("chart-runs").replaceChildren(...[...runs].sort((a, b) => a.cpu_s - b.cpu_s).map(run => el("li", {},
      el("button", { type: "button", className: "object", on: { click: () => this.openRun(run) } },
        el("span", {}, run.name, el("small", {}, `${run.cpu_s.toFixed(1)} s, ${run.cpu_ratio.toFixed(1)} times faster than exact`)),
        el("span", { className: "score" }, typeof run[choice.accuracy] === "number" ? run[choice.accuracy].toFixed(3) : "not evaluated")))));
    byId("chart").showModal();
  }

  // Open the lift of a run's settings, or order one of the same files.
  async openRun(run) {
    const { splats, cameras, features } = this.tradeoff;
    try {
      const { lifts } = await fetchJson(`/lifts?limit=${PAGE_SIZE}`);
      const hasSettings = lift => Object.keys(run.settings).every(name => JSON.stringify(lift.settings[name]) === JSON.stringify(run.settings[name]));
      const existing = lifts.find(lift => lift.splats === splats && lift.cameras === cameras && String(lift.features) === String(features) && hasSettings(lift));
      byId("chart").close();
      if (existing) return await this.onOpen(existing.id);
      notify(`Lifting with \u201c${run.name}\u201d. The lift opens when it is finished.`);
      return await this.onOrder(await post("/lift", { splats, cameras, features, settings: run.settings }), run.name);
    } catch (problem) {
      return notify(problemText(problem), true);
    }
  }
}
