// The page: the open lift, its viewer and panels, and the link that restores their state.
import { QueryPanel, questionLabel, namesByTerm } from "./query.js";
import { Comparison } from "./comparison.js";
import { UploadPanel } from "./uploads.js";
import { byId, formatCount, el, fillSelect, formatBytes, notify } from "./dom.js";
import { SelectionEditor } from "./editor.js";
import { LiftList, liftTitle } from "./lifts.js";
import { LayerPanel, veilMask } from "./layers.js";
import { LabelPanel } from "./labels.js";
import { COLOURS, rgb } from "./painter.js";
import { fetchBytes, fetchJson, storedKey, onAvailability, onUnauthorized, fetchPicture, useKey, problemText } from "./service.js";
import { SharePanel } from "./share.js";
import { ExportPanel } from "./exports.js";
import { ObjectList } from "./objects.js";
import { MAX_SPLATS, ROW_BYTES, Viewer, webgl } from "./viewer.js";

const PAGE_SIZE = 100; // lifts to choose from
const KEY_ANGLE = Math.PI / 24; // radians that an arrow key turns the camera
const DOUBLE_CLICK_TIME = 260; // ms between the clicks of a double click
const POSTER_WIDTH = 960; // pixels of the poster, a rendered picture that is shown until the splats are drawn
const POSTER_WAIT = 1000; // ms that the splats wait for the poster
const SLIDER_REST = 600; // ms from the slider's last move to an entry of the history
const CLICK_DISTANCE = 5; // pixels that the pointer may move during a click

let startParameters = new URLSearchParams(location.search);
const darkScheme = matchMedia("(prefers-color-scheme: dark)");
let lift = null;
let viewer = null;
let openRequest = 0; // number of the last request to open a lift; replies to older ones are dropped
let isOpening = true; // while a lift is opened

const query = new QueryPanel({ onChange: onQueryChange, ownNames: () => objects.ownNames(), flyToBox: box => viewer?.toBox(box) });
const layers = new LayerPanel({
  onChange: () => { repaint(); link(); },
  flyToView: view => viewer?.goToView(view),
  onExample: (term, less) => query.askExample(term, less),
  onPlace: (term, shift, alt) => clickExample(term, shift, alt),
  fallback: !webgl(),
});
const labels = new LabelPanel({
  onChange: onQueryChange,
  centresOf: (values, maxValue) => viewer?.mesh ? viewer.centres(values, maxValue) : [],
  onShow: () => query.reset(true),
});
let hiddenSplats = null; // of objects that are hidden
const objects = new ObjectList({
  namesByTerm,
  onHide: splats => { hiddenSplats = splats; if (viewer?.mesh) viewer.hide(splats); layers.drawView(); },
  selectedSets: () => query.sets,
  selectSets: (sets, word) => query.askSets(sets, word),
  flyToBox: (box, view) => (layers.mode === "view" ? layers.goToView(view) : viewer?.toBox(box, layers.views.find(({ name }) => name === view))),
});
const exporter = new ExportPanel({ query, layers, labels, objects });
const uploads = new UploadPanel({
  onOpen: id => open(id, true), onDelete: () => refreshLifts(), openLiftId: () => lift?.id ?? null, onRaise: () => showTab("bring"), showFile,
});
const comparison = new Comparison({
  viewer: () => viewer,
  createViewer: createPlainViewer,
  hiddenSplats: () => hiddenSplats,
  currentLink: () => String(linkParameters()),
  onChange: link,
});
const lifts = new LiftList({
  onOpen: id => open(id, true),
  onChange: () => refreshLifts(),
});
byId("name-lift").addEventListener("click", () => nameLift(byId("lift-name").hidden));
byId("lift-name").addEventListener("change", () => lifts.renameLift(lift, byId("lift-name").value.trim()).then(() => nameLift(false)));
byId("lift-name").addEventListener("keydown", event => event.key === "Escape" && nameLift(false));
const share = new SharePanel();
const editor = new SelectionEditor({ query, questionLabel, layers, objects, viewer: () => (viewer?.mesh ? viewer : null) });

layers.maskSource = view => {
  const question = query.paintedQuestions().length ? query.current : null;
  if (!question?.answer || !query.paintedQuestions().some(painted => painted.question === question)) return labels.mapSource(view);
  return { path: `/query/mask?${query.requestParameters(question, { view })}`, paint: mask => veilMask(mask, rgb(question.colour)) };
};
layers.examples = () => query.questions.flatMap(({ like, unlike }) => [...like.map(term => ({ term })), ...unlike.map(term => ({ term, unlike: true }))]);

let viewTimer = 0;
let paintedState = ""; // the query or labels of the photo view

// Update the page after a change of the questions, or of their colours.
function onQueryChange() {
  if (query.questions.length) labels.hideLabels();
  objects.render();
  editor.followQuestion();
  repaint();
  if (!sliderTimer) link();
  exporter.render();
  const state = query.current?.answer ? `${query.requestParameters(query.current)}` : labels.isShown ? JSON.stringify([labels.vocabulary, ...labels.selectedValues]) : "";
  clearTimeout(viewTimer);
  if (state !== paintedState) viewTimer = setTimeout(() => { paintedState = state; layers.drawView(); }, 150); // the slider moves often
}

function repaint() {
  if (!viewer?.mesh) return;
  const startTime = performance.now();
  const questions = query.paintedQuestions();
  viewer.paint(questions, { heat: query.heatScores(), layer: labels.paintedLayer() || layers.paintedLayer(), hide: byId("hide").checked });
  const boxes = byId("show-boxes").checked ? [...query.boxes(), ...labels.boxes()] : [];
  viewer.drawBoxes(boxes);
  drawLabels(boxes);
  document.body.dataset.painted = (performance.now() - startTime).toFixed(1);
}

// Draw names at the boxes; the selected one is larger.
function drawLabels(boxes) {
  byId("labels").replaceChildren(...boxes.slice(0, 40).map(box => el("button", {
    type: "button", className: box.strong ? "label strong" : "label", tabIndex: -1, style: { "--mine": box.colour },
    data: { at: JSON.stringify([(box.low[0] + box.high[0]) / 2, (box.low[1] + box.high[1]) / 2, (box.low[2] + box.high[2]) / 2]), box: JSON.stringify([box.low, box.high]) },
    on: { click: () => (box.question ? query.selectObject(box.question, box.objectIndex) : box.labelValue ? labels.toggleValue(box.labelValue) : viewer.toBox(box)) },
  }, box.of > 1 ? `${box.name} ${box.objectIndex + 1}` : box.name)));
}

// After each frame: place the labels at the top of their boxes in the picture, within the window.
function placeLabels(project) {
  if ((viewer?.settled || viewer?.isSteered) && !byId("stage").classList.contains("ready")) showSplats(openRequest);
  const box = byId("query").getBoundingClientRect(); // labels must not cover it
  const stage = byId("labels").getBoundingClientRect();
  const topEdge = x => (x > box.left - stage.left && x < box.right - stage.left ? Math.max(0, box.bottom - stage.top) : 0) + 26;
  const occupied = []; // by labels that are placed; selected ones come first, and none covers another
  const allLabels = [...byId("labels").children].sort((a, b) => b.classList.contains("strong") - a.classList.contains("strong"));
  for (const label of allLabels) {
    const [low, high] = JSON.parse(label.dataset.box);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map(corner => project([0, 1, 2].map(axis => (corner >> axis & 1 ? high : low)[axis])));
    label.hidden = corners.some(corner => !corner.before);
    const [left, right] = [Math.min(...corners.map(corner => corner.x)), Math.max(...corners.map(corner => corner.x))];
    const { clientWidth: width } = byId("labels");
    const half = label.offsetWidth / 2 + 4;
    const x = right < 0 || left > width ? (left + right) / 2 : Math.max(half, Math.min(width - half, (left + right) / 2));
    const top = Math.max(topEdge(x), Math.min(...corners.map(corner => corner.y)) - 4);
    const labelHeight = label.offsetHeight + 2;
    const isFree = y => !occupied.some(other => Math.abs(other.x - x) < other.half + half - 4 && Math.abs(other.y - y) < labelHeight);
    const y = [0, -1, 1, -2, 2, -3].map(step => top + step * labelHeight).find(candidate => candidate >= topEdge(x) && isFree(candidate));
    label.style.visibility = y === undefined ? "hidden" : "";
    if (!label.hidden && y !== undefined) occupied.push({ x, y, half });
    label.style.transform = `translate(-50%, -100%) translate(${x.toFixed(1)}px, ${(y ?? top).toFixed(1)}px)`;
  }
}

let historyState = null; // the questions of the newest entry of the browser's history
let isNavigating = false; // during Back or Forward
let sliderTimer = 0;

// The slider rests: its last position becomes one entry of the history.
function sliderRested() {
  clearTimeout(sliderTimer);
  sliderTimer = 0;
  link();
}

// Write the link of the questions, camera and layer to the address bar. A change of the questions makes an entry of the
// browser's history, a move of the camera does not.
function link() {
  if (!lift || isOpening || isNavigating) return;
  const parameters = linkParameters();
  const fixed = ["view", "layer", "show", "hide", "camera", "heat"];
  const state = String([...parameters].filter(([name]) => !fixed.includes(name)));
  const isPending = query.questions.some(question => !question.answer && !question.problem);
  if (historyState !== null && historyState !== state && isPending) return; // the answer will make the entry
  history[historyState !== null && historyState !== state ? "pushState" : "replaceState"](null, "", `?${parameters}`);
  historyState = state;
}

function linkParameters() {
  const parameters = new URLSearchParams({ lift: lift.id });
  if (layers.view) parameters.set("view", layers.view.name);
  query.link(parameters);
  editor.link(parameters);
  labels.link(parameters);
  if (layers.layerName !== "rgb") parameters.set("layer", layers.layerName);
  if (layers.mode !== "scene" && !layers.fallback) parameters.set("show", layers.mode);
  if (byId("hide").checked) parameters.set("hide", "1");
  if (viewer?.mesh) parameters.set("camera", viewer.place3d.map(value => Number(value.toPrecision(5))).join(","));
  if (comparison.link) parameters.set("beside", comparison.link);
  return parameters;
}

// Back and Forward: restore the questions of that entry.
addEventListener("popstate", async () => {
  const parameters = new URLSearchParams(location.search);
  if (parameters.get("lift") !== lift?.id) { startParameters = parameters; historyState = null; return parameters.has("lift") && open(parameters.get("lift")); }
  isNavigating = true;
  try {
    byId("hide").checked = parameters.has("hide");
    query.reset(false);
    labels.hideLabels();
    await restoreState(parameters);
    if (!query.questions.length) query.reset(true);
  } finally {
    isNavigating = false;
    historyState = null;
    link();
  }
  return undefined;
});

async function restoreState(parameters) {
  const answers = query.restore(parameters);
  await editor.restore(parameters);
  await answers;
  if (!layers.fallback) comparison.restore(parameters);
  if (parameters.has("named")) { showTab("name"); labels.restore(parameters); }
}

function showTab(name) {
  for (const button of document.querySelectorAll("[role=tab]")) {
    const isSelected = button.id === `tab-${name}`;
    button.setAttribute("aria-selected", String(isSelected));
    button.tabIndex = isSelected ? 0 : -1;
    byId(`panel-${button.id.slice(4)}`).hidden = !isSelected;
  }
  if (name === "bring") { uploads.refresh(); refreshLifts().catch(problem => problem.status !== 401 && notify(problemText(problem), true)); }
  if (name === "take") exporter.render();
  repaint();
}

function showLoading(text, share = null) {
  byId("loading").hidden = text === null;
  if (text === null) return;
  byId("loading-text").textContent = text;
  const bar = byId("loading-bar");
  if (share === null) bar.removeAttribute("value"); else bar.value = share;
}

function showProblem(text) {
  byId("trouble").hidden = !text;
  byId("trouble-text").textContent = text || "";
}

async function refreshLifts() {
  const { lifts: list, next } = await fetchJson(`/lifts?limit=${PAGE_SIZE}`);
  const isUnlisted = lift && !list.some(({ id }) => id === lift.id);
  byId("lift-label").hidden = !list.length;
  byId("name-lift").hidden = !lift;
  const choices = [...list, ...(isUnlisted && next ? [lift] : [])].map(entry => [entry.id, liftTitle(entry)]);
  fillSelect(byId("lift"), lift ? choices : [["", "Choose a scene"], ...choices], lift?.id ?? "");
  lifts.render(list, lift?.id);
  if (isUnlisted && !next) { // it was deleted
    closeLift();
    notify("The open scene was deleted.");
  }
  if (!lift && !isOpening && !viewer?.draft && list.length) open(list[0].id); // such as the first lift, once its job has ended
  byId("empty").hidden = Boolean(list.length || viewer?.draft);
  document.body.classList.toggle("no-lifts", !list.length);
  return list;
}

// Show the field for the name of the open scene in place of the choice.
function nameLift(isNaming) {
  byId("lift-name").hidden = !isNaming;
  byId("lift").hidden = isNaming;
  if (!isNaming) return;
  byId("lift-name").value = lift.name ?? "";
  byId("lift-name").focus();
}

function closeLift() {
  openRequest += 1;
  isOpening = false;
  lift = null;
  viewer?.clear();
  byId("poster").hidden = true;
  setLift(null);
  exporter.render();
}

async function open(id, fresh = false) {
  const request = ++openRequest;
  isOpening = true;
  const parameters = !fresh && [null, id].includes(startParameters.get("lift")) ? startParameters : new URLSearchParams();
  showProblem(null);
  try {
    showLoading("Opening the lift");
    const newLift = await fetchJson(`/lifts/${id}`);
    if (request !== openRequest) return;
    lift = newLift;
    byId("empty").hidden = true;
    document.body.classList.remove("no-lifts");
    setLift(null); // its panels ask once the scene is on its way
    byId("mask").hidden = true;
    refreshLifts().catch(problem => notify(problemText(problem), true));
    share.setLift(lift).catch(problem => notify(problemText(problem), true));
    if (fresh) showTab("ask");
    viewer?.clear();
    byId("stage").classList.remove("ready");
    byId("poster").hidden = true;
    await layers.setLift(lift, parameters.get("view"));
    if (request !== openRequest) return;
    // The poster is asked for and sent before the splats, whose first frame may also block the page for seconds.
    await Promise.race([showPoster(parameters, request), new Promise(resolve => setTimeout(resolve, POSTER_WAIT))]);
    const progress = received => request === openRequest && showLoading(`Loading ${formatBytes(received)} of ${formatBytes(ROW_BYTES * lift.count)}`, received / ROW_BYTES / lift.count);
    const splats = layers.fallback ? null : fetchBytes(`/lifts/${id}/splats`, { progress });
    if (request === openRequest) setLift(lift);
    const content = await splats;
    if (request !== openRequest) return;
    if (content) await loadSplats(content, parameters);
    describeScene();
    showWarnings(lift);
    if (parameters.has("layer")) await layers.setLayer(parameters.get("layer"));
    layers.setMode(parameters.get("show") || (layers.fallback ? "view" : "scene"));
    byId("hide").checked = parameters.has("hide");
    showLoading(null);
    isOpening = false;
    await restoreState(parameters);
    link();
  } catch (problem) {
    if (request !== openRequest) return;
    isOpening = false;
    showLoading(null);
    showProblem(problemText(problem));
  }
}

// Open a lift in the panels; null closes it.
function setLift(newLift) {
  hiddenSplats = null;
  query.setLift(newLift);
  comparison.setLift(newLift);
  labels.setLift(newLift);
  objects.setLift(newLift).catch(problem => notify(problemText(problem), true));
}

// Place the camera of the link or of the first view, and show a rendered picture until the splats are drawn.
async function showPoster(parameters, request) {
  viewer ||= layers.fallback ? null : createViewer();
  if (!viewer) return;
  placeCamera(parameters);
  const camera = viewer.cameraRequest(POSTER_WIDTH);
  if (!camera.width || !layers.views.length) return;
  try {
    const image = await fetchPicture("/render", { lift: lift.id, camera });
    if (request !== openRequest || byId("stage").classList.contains("ready")) return URL.revokeObjectURL(image.src);
    if (byId("poster").src) URL.revokeObjectURL(byId("poster").src);
    byId("poster").src = image.src;
    byId("poster").hidden = false;
    await new Promise(resolve => requestAnimationFrame(() => setTimeout(resolve)));
  } catch { /* the splats follow without a poster */ }
}

async function loadSplats(content, parameters) {
  if (!viewer) return;
  showLoading("Unpacking the splats");
  await viewer.load(content);
  if (hiddenSplats) viewer.hide(hiddenSplats);
  if (!viewer.hasFocus) placeCamera(parameters); // now the centre of the scene is known
}

// Replace the poster by the splats.
async function showSplats(request) {
  await viewer.gpuDone();
  if (request !== openRequest) return;
  byId("stage").classList.add("ready");
  setTimeout(() => { if (request === openRequest) byId("poster").hidden = true; }, 600); // the splats fade in above it
}

function placeCamera(parameters) {
  viewer.takeLead();
  viewer.origin = lift.origin;
  viewer.orient(layers.views);
  if (layers.view) viewer.goToView(layers.view, true);
  const camera = (parameters.get("camera") || "").split(",").map(Number);
  if (camera.length === 6 && camera.every(Number.isFinite)) {
    viewer.camera.position.set(...camera.slice(0, 3));
    viewer.controls.target.set(...camera.slice(3));
    viewer.draw();
  }
}

// The 3D viewer; null if WebGL fails, and the page shows photo views.
function createViewer() {
  try {
    const canvas = byId("scene");
    const created = createPlainViewer(canvas, placeLabels);
    created.onMove = link;
    listenToPointer(canvas, created);
    return created;
  } catch (problem) {
    fallBack();
    console.warn(problem);
    return null;
  }
}

function createPlainViewer(canvas, onFrame = () => {}) {
  const created = new Viewer(canvas, onFrame);
  created.background(stageColour());
  return created;
}

const stageColour = () => getComputedStyle(document.documentElement).getPropertyValue("--ground").trim();

function fallBack() {
  layers.fallback = true;
  document.body.classList.add("flat");
  layers.setMode("view");
}

// Show a file of splats in place of the scene, before it is lifted.
async function showFile(file) {
  if (layers.fallback) return;
  try {
    closeLift();
    showLoading(null);
    viewer ||= createViewer();
    await viewer.showFile(new Uint8Array(await file.arrayBuffer()), file.name);
    byId("empty").hidden = true;
    byId("stage").classList.add("ready");
  } catch (problem) {
    console.warn(problem);
    notify("The service reads more formats than this page draws: lift it to see it.", true);
  }
}

// Show the warnings of a lift and of its plan.
async function showWarnings(target) {
  const { plan } = await fetchJson(`/jobs/${target.id}`).catch(() => ({}));
  if (target !== lift) return;
  const warnings = [...new Set([...(plan?.warnings ?? []), ...(target.diagnostics?.warnings ?? [])])];
  byId("warnings").hidden = !warnings.length;
  byId("warnings").replaceChildren(...warnings.map(warning => el("li", {}, warning)));
}

// Describe the scene in the panel of layers.
function describeScene() {
  const drawn = viewer?.mesh && viewer.count < lift.count ? `${formatCount(viewer.count)} of ${formatCount(lift.count)} splats shown (1 in ${Math.ceil(lift.count / MAX_SPLATS)})` : `${formatCount(lift.count)} splats`;
  byId("about").textContent = `${drawn} \u00b7 ${lift.channels} channels \u00b7 ${lift.view_count} views lifted`;
}

function listenToPointer(canvas, target) {
  let down = null;
  let clickTimer = 0;
  let lastClick = -DOUBLE_CLICK_TIME;
  const pickAt = event => {
    const box = canvas.getBoundingClientRect();
    return target.pick(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerdown", event => { down = event.isPrimary ? [event.clientX, event.clientY] : null; });
  canvas.addEventListener("pointerup", event => {
    if (!down || event.button !== 0 || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > CLICK_DISTANCE) return;
    clearTimeout(clickTimer);
    if (event.timeStamp - lastClick < DOUBLE_CLICK_TIME) {
      lastClick = -DOUBLE_CLICK_TIME;
      const hit = pickAt(event);
      if (hit) target.toPoint(hit.point);
      return;
    }
    lastClick = event.timeStamp;
    const { shiftKey, altKey } = event;
    clickTimer = setTimeout(() => clickSplat(pickAt(event), shiftKey, altKey), DOUBLE_CLICK_TIME);
  });
  canvas.addEventListener("keydown", event => handleKey(event, target));
}

const clickSplat = (hit, shift, alt) => (hit ? clickExample(`splat:${hit.splat}`, shift, alt) : notify("There is no splat at this point."));

// A click selects the object there, the next one its part, down to the smallest; one more, or Alt, asks for similar
// splats. Shift selects several objects, or adds a negative example.
async function clickExample(term, shift, alt = false) {
  const isExample = alt || (shift && query.current && !query.sets.length);
  if (!isExample && await objects.selectAt(term, shift)) return undefined;
  return query.askExample(term, shift && !query.sets.length);
}

function handleKey(event, target) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const turns = { ArrowLeft: [-KEY_ANGLE, 0], ArrowRight: [KEY_ANGLE, 0], ArrowUp: [0, -KEY_ANGLE], ArrowDown: [0, KEY_ANGLE] };
  if (turns[event.key]) target.turn(...turns[event.key]);
  else if (event.key === "+" || event.key === "=") target.zoom(0.85);
  else if (event.key === "-") target.zoom(1 / 0.85);
  else if (event.key === "Enter") clickSplat(target.pick(byId("scene").clientWidth / 2, byId("scene").clientHeight / 2), event.shiftKey);
  else return;
  event.preventDefault();
}

// Undo and redo edits of the selection, else questions.
addEventListener("keydown", event => {
  const key = event.key.toLowerCase();
  if (!["z", "y"].includes(key) || !(event.ctrlKey || event.metaKey) || event.target.matches("input[type=text], textarea")) return;
  event.preventDefault();
  const by = key === "y" || event.shiftKey ? 1 : -1;
  if (!editor.step(by)) history.go(by);
});

// Keys of the page, while no text is typed.
addEventListener("keydown", event => {
  if (event.target.matches("input:not([type=radio]):not([type=checkbox]):not([type=range]), select, textarea") || event.ctrlKey || event.metaKey || event.altKey) {
    if (event.key === "Escape") event.target.blur();
    return;
  }
  const action = {
    "/": () => byId("words").focus(), "[": () => layers.stepView(-1), "]": () => layers.stepView(1),
    h: () => byId("hide").click(), b: () => byId("show-boxes").click(), m: () => byId("heat").click(), r: () => layers.view && viewer?.goToView(layers.view),
    "?": () => byId("help").showModal(), Escape: () => { labels.hideLabels(); query.reset(true); },
  }[event.key];
  if (!action || byId("help").open || byId("door").open) return;
  event.preventDefault();
  action();
});

for (const button of document.querySelectorAll("[role=tab]")) {
  button.addEventListener("click", () => showTab(button.id.slice(4)));
  button.addEventListener("keydown", event => {
    const tabs = [...document.querySelectorAll("[role=tab]")];
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!by) return;
    const next = tabs[(tabs.indexOf(button) + by + tabs.length) % tabs.length];
    showTab(next.id.slice(4));
    next.focus();
  });
}
byId("lift").addEventListener("change", () => byId("lift").value && open(byId("lift").value, true));
byId("cut").addEventListener("input", () => { clearTimeout(sliderTimer); sliderTimer = setTimeout(sliderRested, SLIDER_REST); });
byId("cut").addEventListener("change", sliderRested);
for (const id of ["hide", "show-boxes"]) byId(id).addEventListener("change", () => { repaint(); link(); });
byId("again").addEventListener("click", () => location.reload());
byId("reset-view").addEventListener("click", () => layers.view && viewer?.goToView(layers.view));
byId("show-help").addEventListener("click", () => byId("help").showModal());
byId("show-key").addEventListener("click", () => byId("door").showModal());
byId("empty-bring").addEventListener("click", () => { showTab("bring"); byId("files").click(); });
byId("key-form").addEventListener("submit", event => { event.preventDefault(); useKey(byId("key").value.trim()); });
byId("forget").addEventListener("click", () => useKey(""));
for (const button of document.querySelectorAll("[data-close]")) button.addEventListener("click", () => button.closest("dialog").close());
let retryTimer = 0; // of requests to a service that does not answer
onAvailability(answers => {
  byId("offline").hidden = answers;
  if (answers || retryTimer) return;
  retryTimer = setInterval(() => fetchJson("/healthz").then(() => { clearInterval(retryTimer); retryTimer = 0; uploads.refresh(); query.resume(); if (!byId("trouble").hidden) location.reload(); }).catch(() => {}), 3000);
});
byId("open-example").addEventListener("click", () => uploads.example());
onUnauthorized(() => { byId("door-wrong").hidden = !storedKey(); if (!byId("door").open) byId("door").showModal(); });
byId("forget").hidden = !storedKey();
darkScheme.addEventListener("change", () => { viewer?.background(stageColour()); comparison.left?.background(stageColour()); repaint(); query.drawBars(); });

// For tests and for the console of the browser.
Object.assign(globalThis, { splatlift: { query, layers, uploads, exporter, objects, labels, editor, comparison, get viewer() { return viewer; }, get lift() { return lift; }, label: questionLabel, COLOURS } });

async function begin() {
  if (layers.fallback) fallBack();
  layers.showLayer("rgb");
  showTab("ask");
  try {
    const { canWrite } = await share.readKey();
    const list = await refreshLifts();
    const id = startParameters.get("lift") || list[0]?.id;
    if (id) return await open(id);
    isOpening = false;
    if (canWrite) showTab("bring");
    else byId("example-state").textContent = "Your key gives access to no scene. Ask the owner of the key.";
  } catch (problem) {
    if (problem.status !== 401) showProblem(problemText(problem));
  }
}

begin();
