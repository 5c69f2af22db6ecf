// The page: a lift on the stage, what is asked of it, and a link that opens the same again.
import { Ask, label, naming } from "./ask.js";
import { Beside } from "./beside.js";
import { Bring } from "./bring.js";
import { at, count, el, fill, size, notify } from "./dom.js";
import { Hand } from "./hand.js";
import { Lifts, title } from "./lifts.js";
import { Look, veiled } from "./look.js";
import { Masks } from "./masks.js";
import { Names } from "./names.js";
import { COLOURS, rgb } from "./painter.js";
import { bytes, json, keyOf, onHeard, onRefused, picture, useKey, words } from "./service.js";
import { Share } from "./share.js";
import { Take } from "./take.js";
import { Things } from "./things.js";
import { MOST, Viewer, webgl } from "./viewer.js";

const PAGE = 100; // lifts to choose from
const PREVIEWED = 800e6; // bytes of a file that is drawn before it is lifted
const TURN = Math.PI / 24; // of an arrow key
const TWICE = 260; // ms within which a second click makes a double one
const POSTER_WAIT = 1000; // milliseconds that splats wait for that picture at most
const POSTER = 960; // pixels of the service's picture that is shown until the splats are here
const SLIDING = 600; // ms after the slider's last move, until that is an entry of the history
const SHIFTED = 5; // pixels that the pointer may move in a click

let started = new URLSearchParams(location.search);
const dark = matchMedia("(prefers-color-scheme: dark)");
let lift = null;
let viewer = null;
let turn = 0; // of opening lifts: what an older one loads is late and is dropped
let busy = true; // until it is known what to open

const ask = new Ask({ changed, fly: box => viewer?.toBox(box) });
const look = new Look({ changed: () => { repaint(); link(); }, fly: view => viewer?.to(view), pick: (term, less) => pointed(term, less), hit: (term, shift, alt) => hit(term, null, shift, alt), fallback: !webgl() });
const names = new Names({ changed, centres: (values, most) => viewer?.mesh ? viewer.centres(values, most) : [], alone: () => ask.reset(true), more: term => { tab("ask"); ask.example(term, false); } });
const masks = new Masks({ pick: (term, less) => { tab("ask"); ask.example(term, less); }, swap: (old, term) => ask.swap(old, term) });
const things = new Things({ naming, held: () => ask.now?.sets || [], hold: sets => ask.hold(sets), fly: (box, view) => (look.mode === "view" ? look.go(view) : viewer?.toBox(box, look.views.find(({ name }) => name === view))) });
const take = new Take({ ask, look, names, things, shot });
const bring = new Bring({ opened: id => open(id, true), gone: () => refreshLifts(), open: () => lift?.id ?? null, raised: () => tab("bring"), preview });
const beside = new Beside({ viewer: () => viewer, made: plain, now: () => String(linked()), changed: () => { beside.follow(ask.questions, lift); link(); } });
const lifts = new Lifts({ opened: id => open(id, true), changed: () => refreshLifts(), beside: async id => { if (!beside.link) beside.hold(linked()); await open(id, true); } });
const share = new Share();
const hand = new Hand({ ask, label, look, things, viewer: () => (viewer?.mesh ? viewer : null) });

look.asked = view => {
  const question = ask.painted().length ? ask.now : null;
  if (!question?.answer || !ask.painted().some(one => one.question === question)) return names.map(view);
  return { path: `/query/mask?${ask.parameters(question, { view })}`, paint: mask => veiled(mask, rgb(question.colour)) };
};
look.masks = masks;
look.examples = () => ask.questions.flatMap(({ like, unlike }) => [...like.map(term => ({ term })), ...unlike.map(term => ({ term, unlike: true }))]);

let drawn = "";

// After what is asked, or how it is shown, has changed.
function changed() {
  if (ask.questions.length) names.rest();
  things.show();
  hand.follow();
  masks.list(look.examples());
  repaint();
  if (!sliding) link();
  take.show();
  beside.follow(ask.questions, lift);
  const question = ask.now?.answer ? `${ask.parameters(ask.now)}` : names.shown ? JSON.stringify([names.asked, ...names.only]) : "";
  clearTimeout(changed.soon);
  if (question !== drawn) changed.soon = setTimeout(() => { drawn = question; look.draw(); }, 150); // the slider moves often
}

function repaint() {
  if (!viewer?.mesh) return;
  const begun = performance.now();
  const questions = ask.painted();
  viewer.paint(questions, { heat: ask.heated(), layer: names.painted() || look.painted(), hide: at("hide").checked });
  const boxes = at("show-boxes").checked ? [...ask.boxes(), ...names.boxes()] : [];
  viewer.outline(boxes);
  labels(boxes);
  document.body.dataset.painted = (performance.now() - begun).toFixed(1);
}

// Names at the boxes; the chosen one is larger.
function labels(boxes) {
  at("labels").replaceChildren(...boxes.slice(0, 40).map(box => el("button", {
    type: "button", className: box.strong ? "label strong" : "label", tabIndex: -1, style: { "--mine": box.colour },
    data: { at: JSON.stringify([(box.low[0] + box.high[0]) / 2, (box.low[1] + box.high[1]) / 2, (box.low[2] + box.high[2]) / 2]), box: JSON.stringify([box.low, box.high]) },
    on: { click: () => (box.question ? ask.choose(box.question, box.thing) : box.named ? names.press(box.named) : viewer.toBox(box)) },
  }, box.of > 1 ? `${box.name} ${box.thing + 1}` : box.name)));
}

// After each frame: labels lie at the top of their boxes as these are seen, whole where a part of the box is.
function placed(place) {
  if ((viewer?.settled || viewer?.steered) && !at("stage").classList.contains("ready")) appear(turn);
  const box = at("query").getBoundingClientRect(); // which labels stay clear of
  const stage = at("labels").getBoundingClientRect();
  const roof = x => (x > box.left - stage.left && x < box.right - stage.left ? Math.max(0, box.bottom - stage.top) : 0) + 26;
  const taken = []; // boxes of labels that stand, the chosen ones first: none covers another
  const whole = [...at("labels").children].sort((one, other) => other.classList.contains("strong") - one.classList.contains("strong"));
  for (const shown of whole) {
    const [low, high] = JSON.parse(shown.dataset.box);
    const corners = [0, 1, 2, 3, 4, 5, 6, 7].map(which => place([0, 1, 2].map(axis => (which >> axis & 1 ? high : low)[axis])));
    shown.hidden = corners.some(corner => !corner.before);
    const [left, right] = [Math.min(...corners.map(corner => corner.x)), Math.max(...corners.map(corner => corner.x))];
    const { clientWidth: width } = at("labels");
    const half = shown.offsetWidth / 2 + 4;
    const x = right < 0 || left > width ? (left + right) / 2 : Math.max(half, Math.min(width - half, (left + right) / 2));
    const top = Math.max(roof(x), Math.min(...corners.map(corner => corner.y)) - 4);
    const tall = shown.offsetHeight + 2;
    const free = y => !taken.some(one => Math.abs(one.x - x) < one.half + half - 4 && Math.abs(one.y - y) < tall);
    const y = [0, -1, 1, -2, 2, -3].map(step => top + step * tall).find(one => one >= roof(x) && free(one));
    shown.style.visibility = y === undefined ? "hidden" : "";
    if (!shown.hidden && y !== undefined) taken.push({ x, y, half });
    shown.style.transform = `translate(-50%, -100%) translate(${x.toFixed(1)}px, ${(y ?? top).toFixed(1)}px)`;
  }
}

let entry = null; // what is asked in the newest entry of the browser's history
let going = false; // back or forth in it
let sliding = 0;

// The slider rests: what it was moved through is one entry.
function slid() {
  clearTimeout(sliding);
  sliding = 0;
  link();
}

// The address bar holds the link that opens the same question, camera and layer. What is asked anew is an entry of the
// browser's history; a camera that moves is none.
function link() {
  if (!lift || busy || going) return;
  const parameters = linked();
  const fixed = ["view", "what", "show", "hide", "camera", "heat"];
  const now = String([...parameters].filter(([name]) => !fixed.includes(name)));
  const waits = ask.questions.some(question => !question.answer && !question.problem);
  if (entry !== null && entry !== now && waits) return; // it is an entry once it is answered
  history[entry !== null && entry !== now ? "pushState" : "replaceState"](null, "", `?${parameters}`);
  entry = now;
}

function linked() {
  const parameters = new URLSearchParams({ lift: lift.id });
  if (look.view) parameters.set("view", look.view.name);
  ask.link(parameters);
  hand.link(parameters);
  names.link(parameters);
  if (look.what !== "rgb") parameters.set("what", look.what);
  if (look.mode !== "scene" && !look.fallback) parameters.set("show", look.mode);
  if (at("hide").checked) parameters.set("hide", "1");
  if (viewer?.mesh) parameters.set("camera", viewer.place3d.map(value => Number(value.toPrecision(5))).join(","));
  if (beside.link) parameters.set("beside", beside.link);
  return parameters;
}

// Back and forth: what was asked then is asked again.
addEventListener("popstate", async () => {
  const parameters = new URLSearchParams(location.search);
  if (parameters.get("lift") !== lift?.id) { started = parameters; entry = null; return parameters.has("lift") && open(parameters.get("lift")); }
  going = true;
  try {
    at("hide").checked = parameters.has("hide");
    ask.reset(false);
    names.rest();
    await restored(parameters);
    if (!ask.questions.length) ask.reset(true);
  } finally {
    going = false;
    entry = null;
    link();
  }
  return undefined;
});

async function restored(parameters) {
  const answered = ask.restore(parameters);
  await hand.restore(parameters);
  await answered;
  if (!look.fallback) beside.restore(parameters);
  if (parameters.has("named")) { tab("name"); names.restore(parameters); }
}

function tab(name) {
  for (const button of document.querySelectorAll("[role=tab]")) {
    const chosen = button.id === `tab-${name}`;
    button.setAttribute("aria-selected", String(chosen));
    button.tabIndex = chosen ? 0 : -1;
    at(`panel-${button.id.slice(4)}`).hidden = !chosen;
  }
  if (name === "bring") { bring.refresh(); refreshLifts().catch(problem => problem.status !== 401 && notify(words(problem), true)); }
  if (name === "name") names.tables().catch(problem => notify(words(problem), true));
  if (name === "take") take.show();
  repaint();
}

function loading(text, share = null) {
  at("loading").hidden = text === null;
  if (text === null) return;
  at("loading-text").textContent = text;
  const bar = at("loading-bar");
  if (share === null) bar.removeAttribute("value"); else bar.value = share;
}

function trouble(text) {
  at("trouble").hidden = !text;
  at("trouble-text").textContent = text || "";
}

async function refreshLifts() {
  const { lifts: known, next } = await json(`/lifts?limit=${PAGE}`);
  const gone = lift && !known.some(({ id }) => id === lift.id);
  at("lift-label").hidden = !known.length;
  const choices = [...known, ...(gone && next ? [lift] : [])].map(one => [one.id, title(one)]);
  fill(at("lift"), lift ? choices : [["", "Choose a scene"], ...choices], lift?.id ?? "");
  lifts.show(known, lift?.id);
  if (gone && !next) { // it was deleted
    lift = null;
    beside.end();
    viewer?.clear();
    of(null);
    notify("The scene that was open was deleted.");
  }
  if (!lift && !busy && known.length) open(known[0].id); // also the first one, when its job was followed here
  at("empty").hidden = Boolean(known.length || viewer?.draft);
  document.body.classList.toggle("no-lifts", !known.length);
  return known;
}

async function open(id, fresh = false) {
  const mine = ++turn;
  busy = true;
  let parameters = !fresh && [null, id].includes(started.get("lift")) ? started : new URLSearchParams();
  trouble(null);
  try {
    loading("Opening the lift");
    const found = await json(`/lifts/${id}`);
    if (mine !== turn) return;
    if (fresh && lift) parameters = beside.carried(found) ?? parameters;
    lift = found;
    at("empty").hidden = true;
    document.body.classList.remove("no-lifts");
    of(lift);
    at("mask").hidden = at("outline").hidden = true;
    refreshLifts().catch(problem => notify(words(problem), true));
    share.of(lift).catch(problem => notify(words(problem), true));
    if (fresh) tab("ask");
    viewer?.clear();
    at("stage").classList.remove("ready");
    at("poster").hidden = true;
    let poster = null;
    const [content] = await Promise.all([
      look.fallback ? null : bytes(`/lifts/${id}/splats`, { progress: (got, total) => mine === turn && loading(`Loading ${size(got)}${total ? ` of ${size(total)}` : ""}`, total ? got / total : null) }),
      look.of(lift, parameters.get("view")).then(() => { poster = mine === turn ? aim(parameters, mine) : null; }),
    ]);
    // The first drawing of the splats may hold this page for seconds: what is shown meanwhile has to be there before.
    await Promise.race([poster, new Promise(late => setTimeout(late, POSTER_WAIT))]);
    if (mine !== turn) return;
    if (content) await show(content, parameters);
    about();
    warnings(lift);
    if (parameters.has("what")) await look.choose(parameters.get("what"));
    look.switch(parameters.get("show") || (look.fallback ? "view" : "scene"));
    at("hide").checked = parameters.has("hide");
    loading(null);
    busy = false;
    await restored(parameters);
    link();
  } catch (problem) {
    if (mine !== turn) return;
    busy = false;
    loading(null);
    trouble(words(problem));
  }
}

// What belongs to a lift.
function of(known) {
  ask.of(known);
  for (const panel of [things, names, masks]) panel.of(known).catch(problem => notify(words(problem), true));
}

// The camera of the link or of the first view; the service's picture of it is there before the splats are drawn.
async function aim(parameters, mine) {
  viewer ||= look.fallback ? null : made();
  if (!viewer) return;
  stand(parameters);
  const own = viewer.own(POSTER);
  if (!own.width || !look.views.length) return;
  try {
    const image = await picture("/render", { lift: lift.id, camera: own });
    if (mine !== turn || at("stage").classList.contains("ready")) return URL.revokeObjectURL(image.src);
    if (at("poster").src) URL.revokeObjectURL(at("poster").src);
    at("poster").src = image.src;
    at("poster").hidden = false;
    await new Promise(painted => requestAnimationFrame(() => setTimeout(painted)));
  } catch { /* the splats are on their way */ }
}

async function show(content, parameters) {
  if (!viewer) return;
  loading("Unpacking the splats");
  await viewer.load(content);
  if (!viewer.focused) stand(parameters); // now that the scene's middle is known
}

// The splats in place of the poster.
async function appear(mine) {
  await viewer.drawn();
  if (mine !== turn) return;
  at("stage").classList.add("ready");
  setTimeout(() => { if (mine === turn) at("poster").hidden = true; }, 600); // it lies below while they fade in
}

function stand(parameters) {
  viewer.lead();
  viewer.origin = lift.origin;
  viewer.settle(look.views);
  if (look.view) viewer.to(look.view, true);
  const camera = (parameters.get("camera") || "").split(",").map(Number);
  if (camera.length === 6 && camera.every(Number.isFinite)) {
    viewer.camera.position.set(...camera.slice(0, 3));
    viewer.controls.target.set(...camera.slice(3));
    viewer.draw();
  }
}

// The 3D view, or, where it does not start after all, the pictures of views.
function made() {
  try {
    const canvas = at("scene");
    const built = plain(canvas, placed);
    built.moved = link;
    pointing(canvas, built);
    return built;
  } catch (problem) {
    fallBack();
    console.warn(problem);
    return null;
  }
}

function plain(canvas, seen = () => {}) {
  const built = new Viewer(canvas, seen);
  built.background(ground());
  return built;
}

const ground = () => getComputedStyle(document.documentElement).getPropertyValue("--ground").trim();

function fallBack() {
  look.fallback = true;
  document.body.classList.add("flat");
  look.switch("view");
}

// Splats as they were dropped, where no scene is open.
async function preview(file, cameras) {
  if (lift || look.fallback || file.size > PREVIEWED) return;
  try {
    viewer ||= made();
    await viewer?.preview(new Uint8Array(await file.arrayBuffer()), file.name, cameras);
    if (lift || !viewer) return;
    at("empty").hidden = true;
    at("stage").classList.add("ready");
  } catch (problem) {
    console.warn(problem); // the service reads more kinds than this page draws
  }
}

// What a lift warns of, and what its plan did.
async function warnings(known) {
  const { plan } = await json(`/jobs/${known.id}`).catch(() => ({}));
  if (known !== lift) return;
  const warnings = [...new Set([...(plan?.warnings ?? []), ...(known.diagnostics?.warnings ?? [])])];
  at("warnings").hidden = !warnings.length;
  at("warnings").replaceChildren(...warnings.map(warning => el("li", {}, warning)));
}

// What is said of the scene below it.
async function about() {
  const said = [`${count(lift.count)} splats`, `${lift.channels} channels`, `${lift.views.length} views lifted`];
  if (viewer?.mesh && viewer.count < lift.count) said[0] = `${count(viewer.count)} of ${count(lift.count)} splats shown (every ${Math.ceil(lift.count / MOST)}.)`;
  at("about").textContent = said.join(" \u00b7 ");
  try {
    const { counts } = await json(`/assets/${lift.splats}`);
    const kernel = lift.settings.kernel && lift.settings.kernel !== "auto" ? lift.settings.kernel : counts.kernel;
    const note = { "2dgs": "discs drawn as thin Gaussians", dbs: "beta kernels drawn as Gaussians of the nearest size" }[kernel];
    if (note && !look.fallback) at("about").textContent = [...said, note].join(" \u00b7 ");
  } catch { /* said without it */ }
}

function pointing(canvas, built) {
  let down = null;
  let waiting = 0;
  let last = -TWICE;
  const at3d = event => {
    const box = canvas.getBoundingClientRect();
    return built.pick(event.clientX - box.left, event.clientY - box.top);
  };
  canvas.addEventListener("pointerdown", event => { down = event.isPrimary ? [event.clientX, event.clientY] : null; });
  canvas.addEventListener("pointerup", event => {
    if (!down || event.button !== 0 || Math.hypot(event.clientX - down[0], event.clientY - down[1]) > SHIFTED) return;
    clearTimeout(waiting);
    if (event.timeStamp - last < TWICE) {
      last = -TWICE;
      const hit = at3d(event);
      if (hit) built.toPoint(hit.point);
      return;
    }
    last = event.timeStamp;
    const { shiftKey, altKey } = event;
    waiting = setTimeout(() => hit3d(at3d(event), shiftKey, altKey), TWICE);
  });
  canvas.addEventListener("keydown", event => keyed(event, built));
}

const hit3d = (found, shift, alt) => (found ? hit(`splat:${found.splat}`, found.at, shift, alt) : notify("There is no splat there."));

// A click takes the thing there, another one its part, down to the smallest; one more or Alt what is like the place.
// Shift takes several things, or less of what is like a place.
async function hit(term, point, shift, alt = false) {
  const patch = alt || !at("panel-name").hidden || (shift && ask.now && !ask.now.sets.length);
  if (!patch && await things.at(term, shift)) return undefined;
  return pointed(term, shift && !ask.now?.sets.length, point);
}

// Somebody points at a thing: more of it, or with the panel of names what it is.
function pointed(term, less, point = null) {
  return at("panel-name").hidden ? ask.example(term, less) : names.what(term, point);
}

function keyed(event, built) {
  if (event.ctrlKey || event.metaKey || event.altKey) return;
  const turns = { ArrowLeft: [-TURN, 0], ArrowRight: [TURN, 0], ArrowUp: [0, -TURN], ArrowDown: [0, TURN] };
  if (turns[event.key]) built.turn(...turns[event.key]);
  else if (event.key === "+" || event.key === "=") built.zoom(0.85);
  else if (event.key === "-") built.zoom(1 / 0.85);
  else if (event.key === "Enter") hit3d(built.pick(at("scene").clientWidth / 2, at("scene").clientHeight / 2), event.shiftKey);
  else return;
  event.preventDefault();
}

// What is on the screen, with a legend below it: words by their colours, a layer by its name.
async function shot() {
  const parts = look.mode !== "view" && viewer ? [await viewer.is_complete()] : [at("render"), at("over"), at("mask"), at("outline")].filter(part => !part.hidden);
  const [wide, high] = [parts[0].naturalWidth ?? parts[0].width, parts[0].naturalHeight ?? parts[0].height];
  const legend = [...ask.painted().map(({ question }) => [label(question), question.colour]), ...names.entries(), ...(look.what === "rgb" ? [] : [[look.title, null]])];
  const canvas = document.createElement("canvas");
  const context = canvas.getContext("2d");
  const size = Math.max(14, Math.round(wide / 60));
  const font = `${size}px Inter, sans-serif`;
  context.font = font;
  const places = [];
  let [x, y] = [size, high + size * 1.5];
  for (const [name, colour] of legend) {
    const long = context.measureText(name).width + size * (colour ? 2.6 : 1.2);
    if (x > size && x + long > wide) [x, y] = [size, y + size * 1.7];
    places.push([name, colour, x, y]);
    x += long;
  }
  Object.assign(canvas, { width: wide, height: legend.length ? Math.ceil(y + size) : high });
  context.fillStyle = ground();
  context.fillRect(0, 0, canvas.width, canvas.height);
  for (const part of parts) {
    context.globalAlpha = part === parts[0] ? 1 : Number(part.style.opacity || 1);
    context.drawImage(part, 0, 0, wide, high);
  }
  Object.assign(context, { globalAlpha: 1, font, textBaseline: "middle" });
  for (const [name, colour, left, middle] of places) {
    context.fillStyle = colour ?? "#edf0f4";
    if (colour) context.fillRect(left, middle - size / 2, size, size);
    context.fillStyle = "#edf0f4";
    context.fillText(name, left + (colour ? size * 1.5 : 0), middle);
  }
  return new Promise(done => canvas.toBlob(done, "image/png"));
}

// Undo and redo: of things that were joined or split, else of the selection that is corrected, else of what was asked.
addEventListener("keydown", event => {
  const key = event.key.toLowerCase();
  if (!["z", "y"].includes(key) || !(event.ctrlKey || event.metaKey) || event.target.matches("input[type=text], textarea")) return;
  event.preventDefault();
  const by = key === "y" || event.shiftKey ? 1 : -1;
  if (!things.go(by, hand.selection) && !hand.go(by)) history.go(by);
});

// Keys that work wherever no text is typed.
addEventListener("keydown", event => {
  if (event.target.matches("input:not([type=radio]):not([type=checkbox]):not([type=range]), select, textarea") || event.ctrlKey || event.metaKey || event.altKey) {
    if (event.key === "Escape") event.target.blur();
    return;
  }
  const action = {
    "/": () => at("words").focus(), "[": () => look.step(-1), "]": () => look.step(1), n: () => ask.step(1), p: () => ask.step(-1),
    h: () => at("hide").click(), b: () => at("show-boxes").click(), m: () => at("heat").click(), r: () => look.view && viewer?.to(look.view),
    "?": () => at("help").showModal(), Escape: () => { names.rest(); ask.reset(true); },
  }[event.key];
  if (!action || at("help").open || at("door").open) return;
  event.preventDefault();
  action();
});

for (const button of document.querySelectorAll("[role=tab]")) {
  button.addEventListener("click", () => tab(button.id.slice(4)));
  button.addEventListener("keydown", event => {
    const tabs = [...document.querySelectorAll("[role=tab]")];
    const by = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!by) return;
    const next = tabs[(tabs.indexOf(button) + by + tabs.length) % tabs.length];
    tab(next.id.slice(4));
    next.focus();
  });
}
at("lift").addEventListener("change", () => at("lift").value && open(at("lift").value, true));
at("cut").addEventListener("input", () => { clearTimeout(sliding); sliding = setTimeout(slid, SLIDING); });
at("cut").addEventListener("change", slid);
for (const id of ["hide", "show-boxes"]) at(id).addEventListener("change", () => { repaint(); link(); });
at("again").addEventListener("click", () => location.reload());
at("reset-view").addEventListener("click", () => look.view && viewer?.to(look.view));
at("show-help").addEventListener("click", () => at("help").showModal());
at("show-key").addEventListener("click", () => at("door").showModal());
at("empty-bring").addEventListener("click", () => { tab("bring"); at("files").click(); });
at("key-form").addEventListener("submit", event => { event.preventDefault(); useKey(at("key").value.trim()); });
at("forget").addEventListener("click", () => useKey(""));
for (const button of document.querySelectorAll("[data-close]")) button.addEventListener("click", () => button.closest("dialog").close());
let away = 0; // the timer that asks a service which does not answer
onHeard(answers => {
  at("offline").hidden = answers;
  if (answers || away) return;
  away = setInterval(() => json("/healthz").then(() => { clearInterval(away); away = 0; bring.refresh(); ask.resume(); if (!at("trouble").hidden) location.reload(); }).catch(() => {}), 3000);
});
at("open-example").addEventListener("click", () => bring.example());
onRefused(() => { at("door-wrong").hidden = !keyOf(); if (!at("door").open) at("door").showModal(); });
at("forget").hidden = !keyOf();
dark.addEventListener("change", () => { viewer?.background(ground()); beside.left?.background(ground()); repaint(); ask.bars(); });

// For tests, and for the curious in the console.
Object.assign(globalThis, { splatlift: { ask, look, bring, take, things, names, masks, hand, beside, get viewer() { return viewer; }, get lift() { return lift; }, label, COLOURS } });

async function begin() {
  if (look.fallback) fallBack();
  look.showLayer("rgb");
  tab("ask");
  try {
    const { changes } = await share.begin();
    const known = await refreshLifts();
    const wanted = started.get("lift") || known[0]?.id;
    if (wanted) return await open(wanted);
    busy = false;
    if (changes) tab("bring");
    else at("example-state").textContent = "There is no scene that your key may see. Ask whoever gave it to you.";
  } catch (problem) {
    if (problem.status !== 401) trouble(words(problem));
  }
}

begin();
