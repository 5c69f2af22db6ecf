// The chart of a comparison of settings: a point for each run; a click opens its lift.
import { byId, formatCount, el, plural, notify } from "./dom.js";
import { fetchJson, post, download, problemText } from "./service.js";

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 58, right: 24, top: 16, bottom: 46 };
const NAMES = { centred_cosine: "centred cosine in held-out views", mask_iou: "IoU with the masks", phrase_iou: "IoU of words with the masks" };
const PAGE_SIZE = 100; // lifts that are searched for one with the same settings
const LINE_HEIGHT = 15; // pixels between the baselines of two names
const POINT_REACH = 9; // pixels beside a point that stay free of names

export class Chart {
  // onOpen(id): open a lift. onOrder(job, name): follow the job of a new one.
  constructor({ onOpen, onOrder }) {
    Object.assign(this, { onOpen, onOrder });
    new ResizeObserver(() => this.tradeoff && this.draw()).observe(byId("chart-plot"));
    byId("chart-picture").addEventListener("click", () => this.savePicture());
  }

  async show(id) {
    this.tradeoff = await fetchJson(`/tradeoffs/${id}`);
    const { choice, runs, views } = this.tradeoff;
    this.runs = runs.filter(run => typeof run[choice.accuracy] === "number");
    byId("chart-title").textContent = choice.recommended ? `Recommended: \u201c${choice.name}\u201d` : "No run is recommended";
    byId("chart-why").textContent = `${choice.why[0].toUpperCase()}${choice.why.slice(1)}. ${plural(views.lifted, "view")} of ${formatCount(views.of)} lifted, ${formatCount(views.held_out)} held out for evaluation.`;
    byId("chart-runs").replaceChildren(...[...runs].sort((a, b) => a.cpu_s - b.cpu_s).map(run => el("li", {},
      el("button", { type: "button", className: "object", on: { click: () => this.openRun(run) } },
        el("span", {}, run.name, el("small", {}, `${run.cpu_s.toFixed(1)} s, ${run.cpu_ratio.toFixed(1)} times faster than exact`)),
        el("span", { className: "score" }, this.runs.includes(run) ? run[choice.accuracy].toFixed(3) : "not evaluated")))));
    byId("chart").showModal();
    this.draw();
  }

  draw() {
    const { choice } = this.tradeoff;
    const width = byId("chart-plot").clientWidth;
    if (!width || !this.runs.length) return byId("chart-plot").replaceChildren();
    const height = Math.round(Math.max(240, Math.min(460, width * 0.62)));
    const xScale = scale(this.runs.map(run => Math.log10(run.cpu_s)), MARGIN.left, width - MARGIN.right);
    const yScale = scale(this.runs.map(run => run[choice.accuracy]), height - MARGIN.bottom, MARGIN.top);
    const position = run => [xScale.at(Math.log10(run.cpu_s)), yScale.at(run[choice.accuracy])];
    const frontRuns = choice.front.map(name => this.runs.find(run => run.name === name)).filter(Boolean).sort((a, b) => a.cpu_s - b.cpu_s);
    const xTicks = ticks(xScale, [1, 2, 5].flatMap(first => [-3, -2, -1, 0, 1, 2, 3, 4, 5].map(power => Math.log10(first) + power)).sort((a, b) => a - b));
    const step = 10 ** Math.floor(Math.log10(Math.max(yScale.most - yScale.least, 1e-6)));
    const yTicks = ticks(yScale, Array.from({ length: 60 }, (_, number) => (Math.floor(yScale.least / step) + number / 4) * step));
    byId("chart-plot").replaceChildren(svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Seconds against accuracy of each run" },
      ...yTicks.flatMap(value => [svg("line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: yScale.at(value), y2: yScale.at(value), class: "grid" }), text(value.toFixed(step < 0.1 ? 3 : 2), MARGIN.left - 8, yScale.at(value) + 4, "end")]),
      ...xTicks.flatMap(value => [svg("line", { x1: xScale.at(value), x2: xScale.at(value), y1: MARGIN.top, y2: height - MARGIN.bottom, class: "grid" }), text(String(Number((10 ** value).toPrecision(2))), xScale.at(value), height - MARGIN.bottom + 18, "middle")]),
      text("CPU seconds", (MARGIN.left + width) / 2, height - 8, "middle"), text(`\u2191 ${NAMES[choice.accuracy] ?? choice.accuracy}`, MARGIN.left, MARGIN.top - 3, "start"),
      svg("polyline", { points: frontRuns.map(position).join(" "), class: "front" }),
      ...this.pointNames(position, width), ...this.runs.map(run => this.runPoint(run, ...position(run)))));
  }

  runPoint(run, x, y) {
    const { choice } = this.tradeoff;
    const isRecommended = choice.recommended && choice.name === run.name;
    const element = svg("g", { class: `point ${run.kind}${isRecommended ? " taken" : ""}`, tabindex: 0, role: "button", "aria-label": `${run.name}: ${run.cpu_s.toFixed(1)} s, ${run[choice.accuracy].toFixed(3)}. Open its lift` },
      svg("circle", { cx: x, cy: y, r: 16, class: "reach" }), svg("circle", { cx: x, cy: y, r: 7 }), ...(isRecommended ? [svg("circle", { cx: x, cy: y, r: 12, class: "ring" })] : []));
    element.addEventListener("click", () => this.openRun(run));
    element.addEventListener("keydown", event => { if (["Enter", " "].includes(event.key)) { event.preventDefault(); this.openRun(run); } });
    return element;
  }

  // Names beside the points, moved down where they would overlap another name or point.
  pointNames(position, width) {
    const labels = [];
    return [...this.runs].sort((a, b) => position(a)[1] - position(b)[1]).map(run => {
      const [x, y] = position(run);
      const side = x > width / 2 ? -1 : 1;
      const long = 7.2 * run.name.length;
      const [from, right] = side > 0 ? [x, x + long + 14] : [x - long - 14, x];
      let baseline = y + 4;
      const otherPoints = this.runs.filter(other => other !== run).map(position); // stay free as well
      const meets = () => labels.some(a => Math.abs(a.low - baseline) < LINE_HEIGHT && a.from < right && from < a.to)
        || otherPoints.some(([left, high]) => Math.abs(high + 4 - baseline) < LINE_HEIGHT && from < left + POINT_REACH && left - POINT_REACH < right && Math.abs(left - x) > POINT_REACH);
      while (meets()) baseline += 2;
      labels.push({ low: baseline, from, to: right });
      return text(run.name, x + side * 14, baseline, side > 0 ? "start" : "end", "name");
    });
  }

  // Open the lift of a run's settings, or order one of the same files.
  async openRun(run) {
    const { tradeoff } = this;
    try {
      const { lifts } = await fetchJson(`/lifts?limit=${PAGE_SIZE}`);
      const isSame = lift => lift.splats === tradeoff.splats && lift.cameras === tradeoff.cameras && String(lift.features) === String(tradeoff.features) && sameSettings(lift.settings, run.settings);
      const existing = lifts.find(isSame);
      byId("chart").close();
      if (existing) return await this.onOpen(existing.id);
      const { splats, cameras, features } = tradeoff;
      notify(`Lifting with \u201c${run.name}\u201d. The lift opens when it is finished.`);
      return await this.onOrder(await post("/lift", { splats, cameras, features, settings: run.settings }), run.name);
    } catch (problem) {
      return notify(problemText(problem), true);
    }
  }

  async savePicture() {
    try {
      await download(`/tradeoffs/${this.tradeoff.id}/chart`, "speed-against-accuracy.png", undefined, true);
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }
}

const sameSettings = (a, b) => Object.keys(b).every(name => JSON.stringify(a[name]) === JSON.stringify(b[name]));
const text = (content, x, y, anchor, name = "") => {
  const element = svg("text", { x, y, "text-anchor": anchor, class: name });
  element.textContent = content;
  return element;
};

function svg(tag, attributes, ...children) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  element.append(...children);
  return element;
}

// A linear scale from values to pixels, with a margin at both ends.
function scale(values, from, to) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const margin = 0.12 * (high - low) || Math.max(0.1 * Math.abs(high), 1e-3);
  const [minimum, maximum] = [low - margin, high + margin];
  return { least: minimum, most: maximum, at: value => from + (value - minimum) / (maximum - minimum) * (to - from), pixels: Math.abs(to - from) };
}

// The candidate ticks within a scale, thinned to at most one in 55 pixels.
function ticks({ least: minimum, most: maximum, pixels }, marks) {
  const visible = marks.filter(mark => mark >= minimum && mark <= maximum);
  const stride = Math.max(1, Math.ceil(visible.length * 55 / pixels));
  return visible.filter((_, index) => index % stride === 0);
}
