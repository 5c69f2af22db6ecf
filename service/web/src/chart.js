// The chart of a comparison of settings, large: a point for each run, which opens its lift.
import { at, count, el, plural, notify } from "./dom.js";
import { json, post, save, words } from "./service.js";

const SVG = "http://www.w3.org/2000/svg";
const MARGIN = { left: 58, right: 24, top: 16, bottom: 46 };
const NAMES = { centred_cosine: "likeness to views that were not lifted", mask_iou: "overlap with the masks", phrase_iou: "overlap of words with the masks" };
const PAGE = 100; // lifts among which one of the same settings is looked for
const LINE = 15; // pixels from a name to the next below it
const REACH = 9; // of a point, to its sides

export class Chart {
  // opened: with a lift that is to be shown; ordered: with the job of one that is to be, and its name.
  constructor({ opened, ordered }) {
    Object.assign(this, { opened, ordered });
    new ResizeObserver(() => this.tradeoff && this.draw()).observe(at("chart-plot"));
    at("chart-picture").addEventListener("click", () => this.save());
  }

  async show(id) {
    this.tradeoff = await json(`/tradeoffs/${id}`);
    const { choice, runs, views } = this.tradeoff;
    this.shown = runs.filter(run => typeof run[choice.accuracy] === "number");
    at("chart-title").textContent = choice.recommended ? `Take \u201c${choice.name}\u201d` : "No run can be recommended";
    at("chart-why").textContent = `${choice.why[0].toUpperCase()}${choice.why.slice(1)}. ${plural(views.lifted, "view")} of ${count(views.of)} lifted, ${count(views.held_out)} held out to judge by.`;
    at("chart-runs").replaceChildren(...[...runs].sort((one, other) => one.cpu_s - other.cpu_s).map(run => el("li", {},
      el("button", { type: "button", className: "thing", on: { click: () => this.open(run) } },
        el("span", {}, run.name, el("small", {}, `${run.cpu_s.toFixed(1)} s, ${run.cpu_ratio.toFixed(1)} times faster than exact`)),
        el("span", { className: "score" }, this.shown.includes(run) ? run[choice.accuracy].toFixed(3) : "not judged")))));
    at("chart").showModal();
    this.draw();
  }

  draw() {
    const { choice } = this.tradeoff;
    const width = at("chart-plot").clientWidth;
    if (!width || !this.shown.length) return at("chart-plot").replaceChildren();
    const height = Math.round(Math.max(240, Math.min(460, width * 0.62)));
    const across = scale(this.shown.map(run => Math.log10(run.cpu_s)), MARGIN.left, width - MARGIN.right);
    const up = scale(this.shown.map(run => run[choice.accuracy]), height - MARGIN.bottom, MARGIN.top);
    const place = run => [across.at(Math.log10(run.cpu_s)), up.at(run[choice.accuracy])];
    const front = choice.front.map(name => this.shown.find(run => run.name === name)).filter(Boolean).sort((one, other) => one.cpu_s - other.cpu_s);
    const seconds = ticks(across, [1, 2, 5].flatMap(first => [-3, -2, -1, 0, 1, 2, 3, 4, 5].map(power => Math.log10(first) + power)).sort((one, other) => one - other));
    const step = 10 ** Math.floor(Math.log10(Math.max(up.most - up.least, 1e-6)));
    const levels = ticks(up, Array.from({ length: 60 }, (_, number) => (Math.floor(up.least / step) + number / 4) * step));
    at("chart-plot").replaceChildren(svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "Seconds against accuracy of each run" },
      ...levels.flatMap(value => [svg("line", { x1: MARGIN.left, x2: width - MARGIN.right, y1: up.at(value), y2: up.at(value), class: "grid" }), text(value.toFixed(step < 0.1 ? 3 : 2), MARGIN.left - 8, up.at(value) + 4, "end")]),
      ...seconds.flatMap(value => [svg("line", { x1: across.at(value), x2: across.at(value), y1: MARGIN.top, y2: height - MARGIN.bottom, class: "grid" }), text(String(Number((10 ** value).toPrecision(2))), across.at(value), height - MARGIN.bottom + 18, "middle")]),
      text("processor seconds", (MARGIN.left + width) / 2, height - 8, "middle"), text(`\u2191 ${NAMES[choice.accuracy] ?? choice.accuracy}`, MARGIN.left, MARGIN.top - 3, "start"),
      svg("polyline", { points: front.map(place).join(" "), class: "front" }),
      ...this.names(place, width), ...this.shown.map(run => this.point(run, ...place(run)))));
  }

  point(run, x, y) {
    const { choice } = this.tradeoff;
    const taken = choice.recommended && choice.name === run.name;
    const made = svg("g", { class: `point ${run.kind}${taken ? " taken" : ""}`, tabindex: 0, role: "button", "aria-label": `${run.name}: ${run.cpu_s.toFixed(1)} s, ${run[choice.accuracy].toFixed(3)}. Open its lift` },
      svg("circle", { cx: x, cy: y, r: 16, class: "reach" }), svg("circle", { cx: x, cy: y, r: 7 }), ...(taken ? [svg("circle", { cx: x, cy: y, r: 12, class: "ring" })] : []));
    made.addEventListener("click", () => this.open(run));
    made.addEventListener("keydown", event => { if (["Enter", " "].includes(event.key)) { event.preventDefault(); this.open(run); } });
    return made;
  }

  // Names beside the points, lower where they would meet another name or point.
  names(place, width) {
    const taken = [];
    return [...this.shown].sort((one, other) => place(one)[1] - place(other)[1]).map(run => {
      const [x, y] = place(run);
      const half = x > width / 2 ? -1 : 1;
      const long = 7.2 * run.name.length;
      const [from, to] = half > 0 ? [x, x + long + 14] : [x - long - 14, x];
      let low = y + 4;
      const others = this.shown.filter(one => one !== run).map(place); // whose points stay free, too
      const meets = () => taken.some(one => Math.abs(one.low - low) < LINE && one.from < to && from < one.to)
        || others.some(([left, high]) => Math.abs(high + 4 - low) < LINE && from < left + REACH && left - REACH < to && Math.abs(left - x) > REACH);
      while (meets()) low += 2;
      taken.push({ low, from, to });
      return text(run.name, x + half * 14, low, half > 0 ? "start" : "end", "name");
    });
  }

  // The lift of a run's settings: one that is here, or a new one of the same files.
  async open(run) {
    const { tradeoff } = this;
    try {
      const { lifts } = await json(`/lifts?limit=${PAGE}`);
      const same = one => one.splats === tradeoff.splats && one.cameras === tradeoff.cameras && String(one.features) === String(tradeoff.features) && alike(one.settings, run.settings);
      const here = lifts.find(same);
      at("chart").close();
      if (here) return await this.opened(here.id);
      const { splats, cameras, features } = tradeoff;
      notify(`Lifting with \u201c${run.name}\u201d: it opens when it is done.`);
      return await this.ordered(await post("/lift", { splats, cameras, features, settings: run.settings }), run.name);
    } catch (problem) {
      return notify(words(problem), true);
    }
  }

  async save() {
    try {
      await save(`/tradeoffs/${this.tradeoff.id}/chart`, "speed-against-accuracy.png", undefined, true);
    } catch (problem) {
      notify(words(problem), true);
    }
  }
}

const alike = (one, other) => Object.keys(other).every(name => JSON.stringify(one[name]) === JSON.stringify(other[name]));
const text = (content, x, y, anchor, name = "") => {
  const made = svg("text", { x, y, "text-anchor": anchor, class: name });
  made.textContent = content;
  return made;
};

function svg(tag, attributes, ...children) {
  const made = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) made.setAttribute(name, value);
  made.append(...children);
  return made;
}

// From values to pixels, with some room at both ends.
function scale(values, from, to) {
  const [low, high] = [Math.min(...values), Math.max(...values)];
  const room = 0.12 * (high - low) || Math.max(0.1 * Math.abs(high), 1e-3);
  const [least, most] = [low - room, high + room];
  return { least, most, at: value => from + (value - least) / (most - least) * (to - from), pixels: Math.abs(to - from) };
}

// Of marks that may be, those within, as many as have room.
function ticks({ least, most, pixels }, marks) {
  const within = marks.filter(mark => mark >= least && mark <= most);
  const every = Math.max(1, Math.ceil(within.length * 55 / pixels));
  return within.filter((_, place) => place % every === 0);
}
