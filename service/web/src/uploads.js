// The panel Upload: dropped files, the settings of a lift by its schema, jobs with their progress, and stored files.
import { ago, byId, formatCount, el, plural, formatBytes, notify, confirmButton } from "./dom.js";
import { filesOfDrop, zipPhotos, kindOf, suffixes } from "./files.js";
import { textSpaceLabel } from "./lifts.js";
import { download, fetchBytes, events, fetchJson, fetchPicture, patch, post, remove, upload, problemText } from "./service.js";

const PAGE_SIZE = 20; // of each list
const REFRESH_INTERVAL = 15_000; // ms between updates of the lists while the panel is open
const PLAN_DELAY = 400; // ms from the last change to the request of a plan
const SINGLE_KINDS = ["splats", "cameras", "photos", "table"]; // of which the last good file counts
const SCENE_KINDS = ["splats", "cameras", "features", "photos", "table"];
const EXAMPLE = { splats: "point_cloud.spz", cameras: "cameras.json", features: "features.safetensors" };
const GENERIC_NAME = /^(point_cloud|splat|splats|scene|iteration_\d+|\d+)$/i; // names that trainers give to every file
const FINAL_STATES = ["succeeded", "failed", "canceled"];
const REQUIRED_KINDS = { splats: "Splats", cameras: "Cameras", features: "Features" };
const FORMATS = { splats: suffixes("splats"), cameras: "cameras.json, transforms.json, or a COLMAP model: its folder or a .zip", features: `${suffixes("features")} packs` };
const STAGES = { read: "Reading files", digest: "Reading files", compile: "Compiling kernels", plan: "Planning", geometry: "Rasterizing the views",
  solve: "Solving", reweight: "Comparing views", smooth: "Smoothing", diagnose: "Checking the result", save: "Saving" };

export class UploadPanel {
  // onOpen(id): open a lift. onDelete(): after lifts were deleted. openLiftId(): the id of the open lift, or null.
  // onRaise(): show this panel. showFile(file): draw splats before they are lifted.
  constructor({ onOpen, onDelete, openLiftId, onRaise, showFile }) {
    Object.assign(this, { onOpen, onDelete, openLiftId, onRaise, showFile, files: [], followedJobs: new Map(), jobs: [] });
    this.chart = new Chart({ onOrder: (job, name) => this.followOrder(job, { name }) });
    const allowDrop = event => { if ([...event.dataTransfer.types].includes("Files")) event.preventDefault(); };
    addEventListener("dragover", event => { allowDrop(event); document.body.classList.add("dragging"); });
    addEventListener("dragleave", event => { if (!event.relatedTarget) document.body.classList.remove("dragging"); });
    addEventListener("drop", event => {
      allowDrop(event);
      document.body.classList.remove("dragging");
      if (document.body.classList.contains("reader")) notify("Your key cannot upload files. Ask the owner for a key that can write.", true);
      else if (event.dataTransfer.files.length) { this.onRaise(); filesOfDrop(event.dataTransfer).then(files => this.add(files)).catch(problem => notify(problemText(problem), true)); }
    });
    byId("choose").addEventListener("click", () => byId("files").click());
    byId("files").addEventListener("change", () => { this.add([...byId("files").files]); byId("files").value = ""; });
    byId("order").addEventListener("submit", event => { event.preventDefault(); this.submitOrder("/lift"); });
    byId("compare").addEventListener("click", () => this.submitOrder("/tradeoff"));
    byId("order").addEventListener("change", () => this.render());
    byId("more-settings").addEventListener("toggle", () => { if (byId("more-settings").open) this.schema(); });
    setInterval(() => { if (!document.hidden && !byId("panel-bring").hidden) this.refresh(); }, REFRESH_INTERVAL);
    this.render();
  }

  // Begin a new order for files that come after an order, and for splats with other files beside splats that are here.
  async add(files) {
    const typedFiles = await Promise.all((await zipPhotos(files)).map(async content => ({ file: content, ...await kindOf(content) })));
    const kinds = new Set(typedFiles.map(({ kind }) => kind));
    const isNewScene = this.isOrdered || (kinds.has("splats") && kinds.size > 1 && this.files.some(({ kind, asset }) => kind === "splats" && asset));
    if (isNewScene && typedFiles.some(({ kind }) => SCENE_KINDS.includes(kind))) {
      for (const file of this.files) if (!file.asset && !file.problem) file.end?.();
      Object.assign(this, { files: [], isOrdered: false });
    }
    for (const { file: content, kind, reason } of typedFiles) {
      const file = { name: content.name, bytes: content.size, kind, file: content, sentBytes: 0, asset: null, problem: null };
      if (!kind) file.problem = { title: "Not sent", detail: reason ?? (/\.bin$/i.test(content.name) ? "drop the folder of the COLMAP model, or a ZIP of it" : `the file must be one of: ${Object.values(FORMATS).join("; ")}; photos; a lift file`) };
      this.files.push(file);
      if (kind) this.send(file);
    }
    this.render();
  }

  async send(file) {
    const storedCount = this.storedFiles().length;
    const cameras = file.kind === "lift" ? this.ids("cameras").at(-1) : undefined; // for those of a folder, which is a new ZIP each time
    const uploading = upload(file.kind, file.file, sentBytes => { file.sentBytes = sentBytes; this.render(); }, cameras);
    file.end = uploading.end;
    try {
      file.asset = await uploading.done;
      if (SINGLE_KINDS.includes(file.kind)) this.files = this.files.filter(entry => entry === file || entry.kind !== file.kind || !entry.asset);
    } catch (problem) {
      Object.assign(file, { problem, sentBytes: 0 });
      if (storedCount < this.storedFiles().length) this.sendLifts();
    }
    this.render();
    if (!file.asset) return;
    if (file.kind === "lift") {
      this.files = this.files.filter(entry => entry !== file);
      this.render();
      this.onOpen(file.asset.id);
      return;
    }
    this.sendLifts();
  }

  // Upload lift files again whose splats or cameras were not stored.
  sendLifts() {
    for (const file of this.files.filter(({ kind, problem }) => kind === "lift" && problem?.status === 404)) {
      file.problem = null;
      this.send(file);
    }
  }

  storedFiles() {
    return this.files.filter(({ asset }) => asset);
  }

  // Upload and lift the example scene of the service.
  async example() {
    const state = byId("example-state");
    const showState = (text, share) => state.replaceChildren(text, el("progress", share === undefined ? { "aria-label": text } : { max: 1, value: share, "aria-label": text }));
    byId("open-example").disabled = true;
    try {
      showState("Fetching the example\u2026");
      const assets = {};
      for (const [kind, name] of Object.entries(EXAMPLE)) {
        assets[kind] = await upload(kind, new File([await fetchBytes(`/web/example/${name}`)], name), () => {}).done;
        showState("Checking it\u2026");
      }
      const job = await post("/lift", { splats: assets.splats.id, cameras: assets.cameras.id, features: [assets.features.id], settings: {} });
      await this.followOrder(job, { name: "Example: objects on a table", step: ({ stage, completed, total }) => showState(`${STAGES[stage] || stage}\u2026`, total ? completed / total : undefined) });
    } catch (problem) {
      state.textContent = problemText(problem);
    } finally {
      byId("open-example").disabled = false;
    }
  }

  // Attach photos to the open lift.
  async attachPhotos(file) {
    try {
      await patch(`/lifts/${this.openLiftId()}`, { photos: file.asset.id });
      this.onOpen(this.openLiftId());
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }

  render() {
    byId("sent").replaceChildren(...this.files.map(file => this.fileItem(file)));
    const isReady = kind => this.files.some(file => file.kind === kind && file.asset);
    const missing = Object.keys(REQUIRED_KINDS).filter(kind => !isReady(kind));
    const isUploading = this.files.some(file => !file.asset && !file.problem);
    byId("needs").replaceChildren(...Object.keys(REQUIRED_KINDS).map(kind => el("li", { className: isReady(kind) ? "done" : "" },
      el("b", {}, REQUIRED_KINDS[kind]), ` ${isReady(kind) ? "ready" : FORMATS[kind]}`)));
    byId("lift-it").disabled = byId("compare").disabled = Boolean(missing.length) || isUploading;
    byId("settings").hidden = missing.length === 3;
    byId("order-problem").hidden = true; // it was about other files
    if (missing.length || isUploading) byId("plan").hidden = true;
    else this.schedulePlan();
  }

  fileItem(file) {
    const isFinished = file.asset || file.problem;
    const share = file.bytes ? file.sentBytes / file.bytes : 1;
    const needsMore = file.kind === "lift" && file.problem?.status === 404;
    const state = needsMore ? `This lift needs its ${file.problem.argument}: drop them here as well.` : file.problem ? problemText(file.problem) : file.asset ? summarize(file.asset)
      : share >= 1 ? "checking\u2026" : `${formatBytes(file.sentBytes)} of ${formatBytes(file.bytes)}`;
    return el("li", { className: file.problem ? "file bad" : file.asset ? "file done" : "file" },
      el("span", { className: "name" }, file.name), el("span", { className: "kind" }, file.kind || ""),
      isFinished ? null : el("progress", share >= 1 ? { "aria-label": `checking ${file.name}` } : { max: 1, value: share, "aria-label": `upload of ${file.name}` }),
      el("span", { className: "state" }, state),
      ...(file.asset?.warnings || []).map(warning => el("span", { className: "state warning" }, `Note: ${warning}`)),
      file.kind === "splats" && file.file && !file.problem ? el("span", { className: "actions only-3d" }, el("button", { type: "button", on: { click: () => this.showFile(file.file) } }, "Show in 3D")) : null,
      file.kind === "photos" && file.asset && this.openLiftId() ? el("span", { className: "actions" }, el("button", { type: "button", on: { click: () => this.attachPhotos(file) } }, "Attach to this lift")) : null,
      el("button", { type: "button", className: "away", "aria-label": `Remove ${file.name}`,
        on: { click: () => { if (!isFinished) file.end?.(); this.files = this.files.filter(entry => entry !== file); this.render(); } } }, "\u00d7"));
  }

  // Fields for all settings, by the schema of the service.
  async schema() {
    if (this.fields) return;
    this.fields = {};
    try {
      const { components: { schemas } } = await fetchJson("/openapi.json");
      const { properties } = schemas.LiftRequest.properties.settings;
      byId("knobs").replaceChildren(...Object.entries(properties).map(([name, schema]) => {
        const input = this.fields[name] = field(resolveSchema(schema, schemas));
        input.id = `knob-${name}`;
        return el("div", { className: "knob" }, el("label", { htmlFor: input.id }, name), input, el("small", {}, schema.description || ""));
      }));
    } catch (problem) {
      this.fields = null;
      notify(problemText(problem), true);
    }
  }

  settings() {
    const settings = {};
    for (const [name, input] of Object.entries(this.fields || {})) {
      if (input.value === "") continue;
      const value = input.value;
      settings[name] = value === "true" ? true : value === "false" ? false : value !== "" && !Number.isNaN(Number(value)) ? Number(value) : value;
    }
    return settings;
  }

  ids(kind) {
    return this.files.filter(file => file.kind === kind && file.asset).map(file => file.asset.id);
  }

  body() {
    const table = this.ids("table").at(-1);
    return { splats: this.ids("splats").at(-1), cameras: this.ids("cameras").at(-1), features: this.ids("features"), settings: this.settings(), ...(table && { table }) };
  }

  // The name of the splat file, unless it is a generic one.
  sceneName() {
    const { name = "" } = this.files.findLast(file => file.kind === "splats" && file.asset) ?? {};
    const stem = name.replace(/\.[^.]*$/, "");
    return stem && !GENERIC_NAME.test(stem) ? stem.slice(0, 100) : undefined;
  }

  // Request a plan after the last change; an order is planned once.
  schedulePlan() {
    const order = JSON.stringify(this.body());
    if (order === this.plannedFor) { byId("plan").hidden = false; return; }
    clearTimeout(this.planTimer);
    this.planTimer = setTimeout(() => { if (!byId("lift-it").disabled) this.plan(); }, PLAN_DELAY);
  }

  // Show the plan of the lift: its steps, memory and warnings.
  async plan() {
    const body = this.body();
    const order = this.plannedFor = JSON.stringify(body);
    byId("plan").hidden = false;
    byId("plan").replaceChildren(el("li", {}, "Planning\u2026"));
    try {
      const planLines = planItems(await post("/lift/plan", body));
      if (order === this.plannedFor) byId("plan").replaceChildren(...planLines);
    } catch (problem) {
      if (order === this.plannedFor) byId("plan").replaceChildren(el("li", { className: "bad" }, problemText(problem)));
    }
  }

  async submitOrder(path) {
    const body = this.body();
    const { settings } = body;
    if (path === "/tradeoff") {
      delete settings.quality;
      delete body.table;
      body.budget_s = Number(byId("budget").value);
    }
    byId("lift-it").disabled = byId("compare").disabled = true; // a double click orders once
    try {
      const job = await post(path, body);
      byId("order-problem").hidden = true;
      this.isOrdered = path === "/lift";
      this.followOrder(job, { photos: this.ids("photos").at(-1), name: this.sceneName() });
      byId("jobs").scrollIntoView({ block: "nearest" });
    } catch (problem) {
      byId("order-problem").textContent = problemText(problem);
      byId("order-problem").hidden = false;
    } finally {
      byId("lift-it").disabled = byId("compare").disabled = false;
    }
  }

  // List and follow a job that this page ordered.
  followOrder(job, options) {
    this.jobs = [job, ...this.jobs.filter(entry => entry.id !== job.id)];
    this.showJobs();
    return this.follow(job, { ordered: true, ...options });
  }

  // Show the progress of a job until it has ended. A lift that this page ordered is opened then.
  async follow(job, { ordered = false, photos, name, step } = {}) {
    if (this.followedJobs.has(job.id) || FINAL_STATES.includes(job.state)) return;
    const end = new AbortController();
    this.followedJobs.set(job.id, end);
    try {
      for await (const { event, data } of events(`/jobs/${job.id}/events`, end.signal)) {
        if (event === "progress") { job.progress = data; step?.(data); }
        if (event === "state") Object.assign(job, data);
        this.showJobs();
      }
      Object.assign(job, await fetchJson(`/jobs/${job.id}`));
      this.showJobs();
      if ((photos || name) && job.state === "succeeded" && job.kind === "lift") await patch(`/lifts/${job.id}`, { ...(photos && { photos }), ...(name && { name }) });
      if (ordered && job.state === "succeeded" && job.kind === "lift") this.onOpen(job.id);
      else if (job.state === "succeeded") this.onDelete();
    } catch (problem) {
      if (!end.signal.aborted && problem.status !== 401) notify(problemText(problem), true);
    } finally {
      this.followedJobs.delete(job.id);
    }
  }

  async refresh() {
    try {
      const { jobs } = await fetchJson(`/jobs?limit=${PAGE_SIZE}`);
      const followedJobs = new Map(this.jobs.filter(job => this.followedJobs.has(job.id)).map(job => [job.id, job]));
      this.jobs = jobs.map(job => followedJobs.get(job.id) || job);
      this.showJobs();
      for (const job of this.jobs) this.follow(job);
    } catch (problem) {
      if (problem.status !== 401) notify(problemText(problem), true);
    }
  }

  showJobs(force = false) {
    const snapshot = JSON.stringify(this.jobs);
    if (snapshot === this.jobsSnapshot && !force) return; // buttons that wait for a second click stay
    if (byId("jobs").matches(":active")) { // the button under the pointer must stay
      addEventListener("pointerup", () => setTimeout(() => this.showJobs(force)), { once: true });
      return;
    }
    this.jobsSnapshot = snapshot;
    byId("jobs-none").hidden = Boolean(this.jobs.length);
    byId("jobs").replaceChildren(...this.jobs.map(job => this.jobItem(job)));
  }

  jobItem(job) {
    const title = job.kind === "tradeoff" ? `Comparison within ${job.parameters.budget_s} s` : `Lift, ${job.settings.preset}`;
    const parts = [el("span", { className: "name" }, title), el("span", { className: `kind ${job.state}` }, job.state)];
    const step = job.progress;
    if (job.state === "running" && step) {
      const name = STAGES[step.stage] || step.stage;
      parts.push(el("progress", { max: step.total || 1, value: step.completed, "aria-label": name }),
        el("span", { className: "state" }, `${name}${step.total > 1 ? `: ${formatCount(step.completed)} of ${formatCount(step.total)} ${step.unit}` : ""}${step.eta_s ? `, ${Math.ceil(step.eta_s)} s left` : ""}`));
    }
    if (job.problem) parts.push(el("span", { className: "state bad" }, problemText(job.problem)));
    if (FINAL_STATES.includes(job.state) && job.ended) parts.push(el("span", { className: "state" }, `${job.started ? `took ${(job.ended - job.started).toFixed(1)} s, ` : ""}${ago(job.ended)}`));
    const actions = el("span", { className: "actions" });
    if (job.state === "succeeded" && job.kind === "lift") actions.append(el("button", { type: "button", on: { click: () => this.onOpen(job.id) } }, "Open"));
    if (job.state === "succeeded" && job.kind === "tradeoff") actions.append(el("button", { type: "button", on: { click: () => this.chart.show(job.id).catch(problem => notify(problemText(problem), true)) } }, "Show chart"));
    if (["queued", "running"].includes(job.state)) actions.append(el("button", { type: "button", on: { click: () => this.cancel(job) } }, "Cancel"));
    if (FINAL_STATES.includes(job.state)) {
      const query = job.state !== "succeeded" ? "" : job.kind === "lift" ? "?with_lift=true" : "?with_tradeoff=true";
      actions.append(confirmButton("Delete", () => remove(`/jobs/${job.id}${query}`).then(() => { this.jobs = this.jobs.filter(entry => entry !== job); this.showJobs(); this.onDelete(); })));
    }
    return el("li", { className: "job", data: { state: job.state } }, ...parts, actions);
  }

  async cancel(job) {
    try {
      Object.assign(job, await post(`/jobs/${job.id}/cancel`));
      this.showJobs();
    } catch (problem) {
      notify(problemText(problem), true);
    }
  }
}

const planItems = ({ summary, warnings }) => [...warnings.map(warning => el("li", { className: "warning" }, warning)), ...summary.map(line => el("li", {}, line))];

const resolveSchema = (schema, schemas) => (schema.$ref ? { ...schemas[schema.$ref.split("/").at(-1)], ...schema } : schema);

function field(schema) {
  const values = schema.enum || (schema.type === "boolean" ? ["true", "false"] : null);
  const defaultText = schema.default === undefined ? "" : String(schema.default);
  if (values) return el("select", {}, new Option(`unchanged${defaultText ? ` (${defaultText})` : ""}`, ""), ...values.map(value => new Option(String(value), String(value))));
  const isNumber = schema.type === "integer" || schema.type === "number";
  return el("input", { type: isNumber ? "number" : "text", placeholder: defaultText, ...(isNumber ? { step: schema.type === "integer" ? "1" : "any" } : {}),
    ...(schema.minimum === undefined ? {} : { min: schema.minimum }), ...(schema.maximum === undefined ? {} : { max: schema.maximum }) });
}

// The counts of an asset that the service read from it.
function summarize({ kind, counts = {} }) {
  const names = { splats: ["splats", "kernel"], cameras: ["views"], features: ["views", "channels", "text_space"], photos: ["photos"] }[kind] || Object.keys(counts);
  const parts = names.filter(name => ["number", "string"].includes(typeof counts[name])).map(name => {
    if (typeof counts[name] === "string") return name === "text_space" ? textSpaceLabel(counts) : counts[name];
    return plural(counts[name], name.replace(/s$/, "").replaceAll("_", " "));
  });
  return parts.join(", ");
}

// A comparison of settings: the service's chart, and its runs; a click lifts by the settings of one.
class Chart {
  // onOrder(job, name): follow the job of a lift.
  constructor({ onOrder }) {
    Object.assign(this, { onOrder });
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

  // Order a lift by a run's settings of the same files.
  async openRun(run) {
    const { splats, cameras, features } = this.tradeoff;
    try {
      byId("chart").close();
      notify(`Lifting with \u201c${run.name}\u201d. The lift opens when it is finished.`);
      return await this.onOrder(await post("/lift", { splats, cameras, features, settings: run.settings }), run.name);
    } catch (problem) {
      return notify(problemText(problem), true);
    }
  }
}
