// The panel of bringing: files by drag and drop, the settings of a lift from the schema, jobs as they run, and what
// is here already.
import { Chart } from "./chart.js";
import { ago, at, count, el, plural, size, notify, twice } from "./dom.js";
import { camerasOf, dropped, gathered, kindOf, named, remember, suffixes } from "./files.js";
import { space } from "./lifts.js";
import { bytes, events, json, patch, post, remove, upload, words } from "./service.js";

const PAGE = 20; // of each list
const LOOK = 15_000; // ms between looks for jobs of others, while the panel is open
const REST = 400; // ms without a change, after which it is planned
const OF_SCENE = ["splats", "cameras", "features", "photos", "table"];
const AGAIN = 2000; // ms, within which the same order is a second click
const EXAMPLE = { splats: "point_cloud.spz", cameras: "cameras.json", features: "features.safetensors" };
const USUAL = /^(point_cloud|splat|splats|scene|iteration_\d+|\d+)$/i; // names that trainers give to every scene
const ENDED = ["succeeded", "failed", "canceled"];
const KINDS = { splats: "Splats", cameras: "Cameras", features: "Features" };
const OTHERS = { photos: "Photos", lift: "Lift", masks: "Masks", table: "Words" };
const WANTED = { splats: suffixes("splats"), cameras: "cameras.json, transforms.json, or a COLMAP model: its folder or a .zip", features: `${suffixes("features")} packs` };
const PRESETS = {
  default: ["Careful", "Masks that other views contradict count less; splats get a confidence."],
  tikhonov: ["Sharp", "The paper's best: strong weights count more."],
  "row-sum": ["Plain", "Every splat takes the mean of what its rays see."],
  "top-k": ["Front splats", "The largest weights of each ray alone."],
};
const SPEEDS = { exact: "every pixel", balanced: "every 4th pixel", fast: "fewer views too", draft: "a first look" };
const STAGES = { read: "Reading files", digest: "Reading files", compile: "Compiling kernels", plan: "Planning", geometry: "Looking through the views",
  solve: "Solving", robust: "Comparing views", halves: "Comparing halves of the views", smooth: "Smoothing", certify: "Checking the result", save: "Saving" };

export class Bring {
  // opened: with a lift that is to be shown; gone: after lifts were deleted.
  // open: the id of the lift that is shown, or null; raised: to bring the panel to the front.
  // preview: with a file of splats and what cameras there are, to be seen before they are lifted.
  constructor({ opened, gone, open, raised, preview }) {
    Object.assign(this, { opened, gone, open, raised, preview, cameras: [], files: [], followed: new Map(), jobs: [] });
    this.chart = new Chart({ opened, ordered: (job, name) => this.begin(job, { name }) });
    const stop = event => { if ([...event.dataTransfer.types].includes("Files")) event.preventDefault(); };
    addEventListener("dragover", event => { stop(event); document.body.classList.add("dragging"); });
    addEventListener("dragleave", event => { if (!event.relatedTarget) document.body.classList.remove("dragging"); });
    addEventListener("drop", event => {
      stop(event);
      document.body.classList.remove("dragging");
      if (document.body.classList.contains("reader")) notify("Your key is for looking and asking: it brings no files.", true);
      else if (event.dataTransfer.files.length) { this.raised(); dropped(event.dataTransfer).then(files => this.add(files)).catch(problem => notify(words(problem), true)); }
    });
    at("choose").addEventListener("click", () => at("files").click());
    at("files").addEventListener("change", () => { this.add([...at("files").files]); at("files").value = ""; });
    at("order").addEventListener("submit", event => { event.preventDefault(); this.order("/lift"); });
    at("compare").addEventListener("click", () => this.order("/tradeoff"));
    at("plan-it").addEventListener("click", () => this.plan());
    at("order").addEventListener("change", () => this.show());
    at("preset").replaceChildren(...Object.entries(PRESETS).map(([name, [title, why]], place) => choice("preset", name, title, why, place === 0)));
    at("speed").replaceChildren(...Object.entries(SPEEDS).map(([name, why], place) => choice("speed", name, name, why, place === 0)));
    at("more-settings").addEventListener("toggle", () => { if (at("more-settings").open) this.schema(); });
    setInterval(() => { if (!document.hidden && !at("panel-bring").hidden) this.refresh(); }, LOOK);
    const before = begun();
    this.show();
    this.resume(before);
  }

  // What was dropped before the page was loaded again: what is here already stays, and the rest is named, as a browser
  // hands its files to one page alone.
  async resume(files) {
    const before = await Promise.all(files.map(async ({ name, bytes: length, kind, id }) => {
      const one = { name, bytes: length, kind, sent: 0, asset: id ? await json(`/assets/${id}`).catch(() => null) : null, problem: null };
      return one.asset ? one : { ...one, problem: { title: "Not here yet", detail: "this page was loaded again while it went up; drop it once more" }, left: true };
    }));
    if (this.files.length || !before.length) return;
    this.files = before;
    this.show();
    if (before.some(({ left }) => left)) this.raised();
  }

  // Files after an order, or splats with others of theirs, are of another scene: a new order.
  async add(files) {
    const all = await Promise.all((await gathered(files)).map(async file => ({ file, ...await kindOf(file) })));
    const kinds = new Set(all.map(({ kind }) => kind));
    const anew = this.ordered || (kinds.has("splats") && kinds.size > 1 && this.files.some(({ kind, asset }) => kind === "splats" && asset));
    if (anew && all.some(({ kind }) => OF_SCENE.includes(kind))) {
      for (const one of this.files) if (!one.asset && !one.problem) one.end?.();
      Object.assign(this, { files: [], cameras: [], ordered: false });
    }
    this.look(all);
    for (const { file, kind, needs, why } of all) {
      const one = { name: file.name, bytes: file.size, kind, needs, file, sent: 0, asset: null, problem: null };
      if (!kind) one.problem = { title: "Not sent", detail: why ?? (/\.bin$/i.test(file.name) ? "drop the folder of the COLMAP model, or a zip of it" : `it is none of ${Object.values(WANTED).join("; ")}; photos; or a lift file`) };
      this.files = this.files.filter(known => !(known.left && known.name === file.name && known.bytes === file.size));
      if (kind && kind !== "features") this.files = this.files.filter(known => known.kind !== kind || !known.asset);
      this.files.push(one);
      if (kind === "lift") this.sendLift(one);
      else if (kind) this.send(one);
    }
    this.show();
  }

  // What was dropped is seen at once.
  async look(all) {
    const cameras = all.find(({ kind }) => kind === "cameras");
    const splats = all.find(({ kind }) => kind === "splats");
    if (cameras) this.cameras = await camerasOf(cameras.file);
    if (splats) this.seen = splats.file;
    if ((splats || cameras) && this.seen) this.preview(this.seen, this.cameras);
  }

  async send(one, cameras) {
    const sending = upload(one.kind, one.file, sent => { one.sent = sent; this.show(); }, cameras);
    one.end = sending.end;
    try {
      one.asset = await sending.done;
      remember(one.asset.id, one.name);
    } catch (problem) {
      Object.assign(one, { problem, sent: 0 }); // a lift may go up again, with other cameras
    }
    this.show();
    if (!one.asset) return;
    if (one.kind === "lift") {
      this.files = this.files.filter(known => known !== one);
      this.show();
      this.opened(one.asset.id);
      return;
    }
    this.refreshAssets();
    for (const other of this.files) if (other.kind === "lift" && !other.asset) this.sendLift(other);
  }

  // The scene that ships with the service, lifted as one that was brought.
  async example() {
    const state = at("example-state");
    const tellState = (text, share) => state.replaceChildren(text, el("progress", share === undefined ? { "aria-label": text } : { max: 1, value: share, "aria-label": text }));
    at("open-example").disabled = true;
    try {
      tellState("Fetching the example\u2026");
      const assets = {};
      for (const [kind, name] of Object.entries(EXAMPLE)) {
        assets[kind] = await upload(kind, new File([await bytes(`/web/example/${name}`)], name), () => {}).done;
        tellState("Checking it\u2026");
      }
      const job = await post("/lift", { splats: assets.splats.id, cameras: assets.cameras.id, features: [assets.features.id], settings: {} });
      await this.begin(job, { name: "Example: things on a table", step: ({ stage, done, total }) => tellState(`${STAGES[stage] || stage}\u2026`, total ? done / total : undefined) });
    } catch (problem) {
      state.textContent = words(problem);
    } finally {
      at("open-example").disabled = false;
    }
  }

  // A lift file goes up once what it was made of is here. One look at a time, as a late answer would hide a newer one;
  // what comes in meanwhile asks for one more.
  async sendLift(one) {
    one.again = true;
    if (one.looking) return;
    for (one.looking = true; one.again && this.files.includes(one);) {
      one.again = false;
      try {
        await this.sendOnceComplete(one);
      } catch (problem) {
        one.problem = problem;
        this.show();
      }
    }
    one.looking = false;
  }

  // Its cameras may have been a folder, of which there is no file: then those that were dropped stand for them, if they
  // see the same.
  async sendOnceComplete(one) {
    const absent = need => json(`/assets/${need.id}`).then(() => [], problem => { if (problem.status === 404) return [need]; throw problem; });
    one.missing = (await Promise.all(one.needs.map(absent))).flat();
    this.show();
    const others = one.missing.length === 1 && one.missing[0].kind === "cameras" ? this.ids("cameras").at(-1) : undefined;
    const cameras = one.missing.length ? others : ""; // none: its own
    if (cameras === undefined || cameras === one.tried) return;
    Object.assign(one, { tried: cameras, problem: null });
    await this.send(one, cameras);
  }

  // Photos beside the lift that is open.
  async beside(one) {
    try {
      await patch(`/lifts/${this.open()}`, { photos: one.asset.id });
      this.opened(this.open());
    } catch (problem) {
      notify(words(problem), true);
    }
  }

  // An asset that is here already, taken for the next lift.
  take(asset) {
    if (this.files.some(one => one.asset?.id === asset.id)) return;
    if (asset.kind !== "features") this.files = this.files.filter(one => one.kind !== asset.kind);
    this.files.push({ name: named(asset.id) ?? `${KINDS[asset.kind]} from before`, bytes: asset.bytes, kind: asset.kind, sent: asset.bytes, asset, problem: null });
    this.show();
    at("drop").scrollIntoView({ block: "nearest" });
  }

  show() {
    keep(this.ordered ? [] : this.files.filter(one => OF_SCENE.includes(one.kind) && (one.asset || one.left || !one.problem)));
    at("sent").replaceChildren(...this.files.map(one => this.line(one)));
    const has = kind => this.files.some(one => one.kind === kind && one.asset);
    const missing = Object.keys(KINDS).filter(kind => !has(kind));
    const busy = this.files.some(one => !one.asset && !one.problem && !one.missing?.length);
    at("needs").replaceChildren(...Object.keys(KINDS).map(kind => el("li", { className: has(kind) ? "done" : "" },
      el("b", {}, KINDS[kind]), ` ${has(kind) ? "ready" : WANTED[kind]}`)));
    at("lift-it").disabled = at("compare").disabled = at("plan-it").disabled = Boolean(missing.length) || busy;
    at("settings").hidden = missing.length === 3;
    at("order-problem").hidden = true; // of other files
    if (missing.length || busy) at("plan").hidden = true;
    else this.planSoon();
  }

  line(one) {
    const done = one.asset || one.problem;
    const share = one.bytes ? one.sent / one.bytes : 1;
    const state = one.problem ? words(one.problem) : one.asset ? said(one.asset)
      : one.missing?.length && !one.sent ? `This lift was made of ${one.missing.map(({ kind, name }) => `${name || "its"} (${kind})`).join(" and ")}: drop ${one.missing.length > 1 ? "them" : "it"} here, too.`
      : share >= 1 ? "checking it\u2026" : `${size(one.sent)} of ${size(one.bytes)}`;
    return el("li", { className: one.problem ? "file bad" : one.asset ? "file done" : "file" },
      el("span", { className: "name" }, one.name), el("span", { className: "kind" }, one.kind || ""),
      done || (one.missing?.length && !one.sent) ? null : el("progress", share >= 1 ? { "aria-label": `checking ${one.name}` } : { max: 1, value: share, "aria-label": `upload of ${one.name}` }),
      el("span", { className: "state" }, state),
      ...(one.asset?.warnings || []).map(warning => el("span", { className: "state warning" }, `Note: ${warning}`)),
      one.kind === "photos" && one.asset && this.open() ? el("span", { className: "actions" }, el("button", { type: "button", on: { click: () => this.beside(one) } }, "Show beside this scene")) : null,
      el("button", { type: "button", className: "away", "aria-label": `Take ${one.name} away`,
        on: { click: () => { if (!done) one.end?.(); this.files = this.files.filter(known => known !== one); this.show(); } } }, "\u00d7"));
  }

  // The knobs behind the presets, from the service's own schema.
  async schema() {
    if (this.fields) return;
    this.fields = {};
    try {
      const { components: { schemas } } = await json("/openapi.json");
      const { properties } = schemas.LiftRequest.properties.settings;
      at("knobs").replaceChildren(...Object.entries(properties).filter(([name, schema]) => !schema.deprecated && !["speed"].includes(name)).map(([name, schema]) => {
        const input = this.fields[name] = field(resolved(schema, schemas));
        input.id = `knob-${name}`;
        return el("div", { className: "knob" }, el("label", { htmlFor: input.id }, name), input, el("small", {}, schema.description || ""));
      }));
    } catch (problem) {
      this.fields = null;
      notify(words(problem), true);
    }
  }

  settings() {
    const chosen = { preset: at("order").elements.preset.value, speed: at("order").elements.speed.value };
    for (const [name, input] of Object.entries(this.fields || {})) {
      if (input.value === "") continue;
      const value = input.value;
      chosen[name] = value === "true" ? true : value === "false" ? false : value !== "" && !Number.isNaN(Number(value)) ? Number(value) : value;
    }
    return chosen;
  }

  ids(kind) {
    return this.files.filter(one => one.kind === kind && one.asset).map(one => one.asset.id);
  }

  body() {
    const table = this.ids("table").at(-1);
    return { splats: this.ids("splats").at(-1), cameras: this.ids("cameras").at(-1), features: this.ids("features"), settings: this.settings(), ...(table && { table }) };
  }

  // By the file of its splats, where that says more than a trainer's usual names do.
  sceneName() {
    const { name = "" } = this.files.findLast(one => one.kind === "splats" && one.asset) ?? {};
    const stem = name.replace(/\.[^.]*$/, "");
    return stem && !USUAL.test(stem) ? stem.slice(0, 100) : undefined;
  }

  // The plan of what is here, once it rests; the same is not planned twice.
  planSoon() {
    const order = JSON.stringify(this.body());
    if (order === this.plannedFor) { at("plan").hidden = false; return; }
    clearTimeout(this.planning);
    this.planning = setTimeout(() => { if (!at("lift-it").disabled) this.plan(); }, REST);
  }

  // What the lift would do and need, before it is ordered.
  async plan() {
    const body = this.body();
    const mine = this.plannedFor = JSON.stringify(body);
    at("plan").hidden = false;
    at("plan").replaceChildren(el("li", {}, "Planning\u2026"));
    try {
      const planLines = lines(await post("/lift/plan", body));
      if (mine === this.plannedFor) at("plan").replaceChildren(...planLines);
    } catch (problem) {
      if (mine === this.plannedFor) at("plan").replaceChildren(el("li", { className: "bad" }, words(problem)));
    }
  }

  async order(path) {
    const body = this.body();
    const { settings } = body;
    if (path === "/tradeoff") {
      delete settings.speed;
      delete body.table;
      body.budget_s = Number(at("budget").value);
    }
    // A double click orders once: the service takes the same order with the same key for the same job.
    const order = path + JSON.stringify(body);
    if (this.last?.order !== order || this.last.until < Date.now()) this.last = { order, key: `${Date.now()}-${Math.random()}` };
    this.last.until = Date.now() + AGAIN;
    try {
      const job = await post(path, body, { "Idempotency-Key": this.last.key });
      at("order-problem").hidden = true;
      this.ordered = path === "/lift";
      remember(job.id, this.sceneName() ?? this.ids("splats").map(named).at(-1));
      this.begin(job, { photos: this.ids("photos").at(-1), name: this.sceneName() });
      at("jobs").scrollIntoView({ block: "nearest" });
    } catch (problem) {
      at("order-problem").textContent = words(problem);
      at("order-problem").hidden = false;
    }
  }

  // A job that was ordered here.
  begin(job, more) {
    this.jobs = [job, ...this.jobs.filter(known => known.id !== job.id)];
    this.showJobs();
    return this.follow(job, { ordered: true, ...more });
  }

  // Live progress, until the job has ended. What was ordered here is opened when it is done.
  async follow(job, { ordered = false, photos, name, step } = {}) {
    if (this.followed.has(job.id) || ENDED.includes(job.state)) return;
    const end = new AbortController();
    this.followed.set(job.id, end);
    try {
      for await (const { event, data } of events(`/jobs/${job.id}/events`, end.signal)) {
        if (event === "progress") { job.progress = data; step?.(data); }
        if (event === "plan") job.plan = data;
        if (event === "state") Object.assign(job, data);
        this.showJobs();
      }
      Object.assign(job, await json(`/jobs/${job.id}`));
      this.showJobs();
      if ((photos || name) && job.state === "succeeded" && job.kind === "lift") await patch(`/lifts/${job.id}`, { ...(photos && { photos }), ...(name && { name }) });
      if (ordered && job.state === "succeeded" && job.kind === "lift") this.opened(job.id);
      else if (job.state === "succeeded") this.gone();
    } catch (problem) {
      if (!end.signal.aborted && problem.status !== 401) notify(words(problem), true);
    } finally {
      this.followed.delete(job.id);
    }
  }

  async refresh() {
    try {
      const { jobs } = await json(`/jobs?limit=${PAGE}`);
      const known = new Map(this.jobs.filter(job => this.followed.has(job.id)).map(job => [job.id, job]));
      this.jobs = jobs.map(job => known.get(job.id) || job);
      this.showJobs();
      for (const job of this.jobs) this.follow(job);
      await this.refreshAssets();
    } catch (problem) {
      if (problem.status !== 401) notify(words(problem), true);
    }
  }

  async refreshAssets() {
    const { assets, next } = await json(`/assets?limit=${PAGE}`);
    const snapshot = JSON.stringify(assets);
    if (snapshot === this.assetsSnapshot) return;
    this.assetsSnapshot = snapshot;
    at("assets-count").textContent = assets.length ? `(${assets.length}${next ? "+" : ""})` : "(none)";
    at("assets").replaceChildren(...assets.map(asset => el("li", {},
      el("span", { className: "name" }, named(asset.id) ?? KINDS[asset.kind] ?? OTHERS[asset.kind] ?? asset.kind), el("span", { className: "state" }, `${said(asset)} \u00b7 ${size(asset.bytes)} \u00b7 ${ago(asset.created)}`),
      el("span", { className: "actions" },
        KINDS[asset.kind] ? el("button", { type: "button", on: { click: () => this.take(asset) } }, "Lift it again") : null,
        twice("Delete", () => remove(`/assets/${asset.id}`).then(() => this.refreshAssets()))))));
  }

  showJobs(anew = false) {
    const snapshot = JSON.stringify(this.jobs);
    if (snapshot === this.jobsSnapshot && !anew) return; // buttons that ask once more stay
    if (at("jobs").matches(":active")) { // a press that goes on would lose its button
      addEventListener("pointerup", () => setTimeout(() => this.showJobs(anew)), { once: true });
      return;
    }
    this.jobsSnapshot = snapshot;
    at("jobs-none").hidden = Boolean(this.jobs.length);
    at("jobs").replaceChildren(...this.jobs.map(job => this.job(job)));
  }

  job(job) {
    const what = job.kind === "tradeoff" ? `Comparison within ${job.parameters.budget_s} s` : `Lift, ${job.settings.preset}`;
    const kind = named(job.id) ? `${named(job.id)}: ${what.toLowerCase()}` : what;
    const parts = [el("span", { className: "name" }, kind), el("span", { className: `kind ${job.state}` }, job.state)];
    const step = job.progress;
    if (job.state === "running" && step) {
      const name = STAGES[step.stage] || step.stage;
      parts.push(el("progress", { max: step.total || 1, value: step.done, "aria-label": name }),
        el("span", { className: "state" }, `${name}${step.total > 1 ? `: ${count(step.done)} of ${count(step.total)} ${step.unit}` : ""}${step.eta_s ? `, ${Math.ceil(step.eta_s)} s left` : ""}`));
    }
    if (job.plan && !ENDED.includes(job.state)) parts.push(el("ul", { className: "plan" }, ...lines(job.plan)));
    if (job.problem) parts.push(el("span", { className: "state bad" }, words(job.problem)));
    if (ENDED.includes(job.state) && job.ended) parts.push(el("span", { className: "state" }, `${job.started ? `took ${(job.ended - job.started).toFixed(1)} s, ` : ""}${ago(job.ended)}`));
    const actions = el("span", { className: "actions" });
    if (job.state === "succeeded" && job.kind === "lift") actions.append(el("button", { type: "button", on: { click: () => this.opened(job.id) } }, "Open"));
    if (job.state === "succeeded" && job.kind === "tradeoff") actions.append(el("button", { type: "button", on: { click: () => this.chart.show(job.id).catch(problem => notify(words(problem), true)) } }, "Show chart"));
    if (["queued", "running"].includes(job.state)) actions.append(el("button", { type: "button", on: { click: () => this.cancel(job) } }, "Cancel"));
    if (ENDED.includes(job.state)) {
      const going = job.state !== "succeeded" ? "" : job.kind === "lift" ? "?with_lift=true" : "?with_tradeoff=true";
      actions.append(twice("Delete", () => remove(`/jobs/${job.id}${going}`).then(() => { this.jobs = this.jobs.filter(known => known !== job); this.showJobs(); this.gone(); })));
    }
    return el("li", { className: "job", data: { state: job.state } }, ...parts, actions);
  }

  async cancel(job) {
    try {
      Object.assign(job, await post(`/jobs/${job.id}/cancel`));
      this.showJobs();
    } catch (problem) {
      notify(words(problem), true);
    }
  }
}

// The files of an order that is being put together, for this tab alone.
const BEGUN = "splatlift-order";
const begun = () => { try { return JSON.parse(sessionStorage.getItem(BEGUN)) ?? []; } catch { return []; } };
function keep(files) {
  try {
    sessionStorage.setItem(BEGUN, JSON.stringify(files.map(({ name, bytes: length, kind, asset }) => ({ name, bytes: length, kind, id: asset?.id ?? null }))));
  } catch { /* a browser that keeps nothing */ }
}

const lines = ({ summary, warnings }) => [...warnings.map(warning => el("li", { className: "warning" }, warning)), ...summary.map(line => el("li", {}, line))];

function choice(group, value, title, why, checked) {
  return el("label", { className: "choice" }, el("input", { type: "radio", name: group, value, checked }), el("span", {}, el("b", {}, title), el("small", {}, why)));
}

const resolved = (schema, schemas) => (schema.$ref ? { ...schemas[schema.$ref.split("/").at(-1)], ...schema } : schema);

function field(schema) {
  const values = schema.enum || (schema.type === "boolean" ? ["true", "false"] : null);
  const usual = schema.default === undefined ? "" : String(schema.default);
  if (values) return el("select", {}, new Option(`as the preset has it${usual ? ` (${usual})` : ""}`, ""), ...values.map(value => new Option(String(value), String(value))));
  const number = schema.type === "integer" || schema.type === "number";
  return el("input", { type: number ? "number" : "text", placeholder: usual, ...(number ? { step: schema.type === "integer" ? "1" : "any" } : {}),
    ...(schema.minimum === undefined ? {} : { min: schema.minimum }), ...(schema.maximum === undefined ? {} : { max: schema.maximum }) });
}

// What the check found in a file.
function said({ kind, counts = {} }) {
  const names = { splats: ["splats", "kernel"], cameras: ["views"], features: ["views", "channels", "text_space"], photos: ["photos"] }[kind] || Object.keys(counts);
  const parts = names.filter(name => ["number", "string"].includes(typeof counts[name])).map(name => {
    if (typeof counts[name] === "string") return name === "text_space" ? space(counts) : counts[name];
    return plural(counts[name], name.replace(/s$/, "").replaceAll("_", " "));
  });
  return parts.join(", ");
}
