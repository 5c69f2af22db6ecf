"use strict";
const at = id => document.getElementById(id);
const started = new URLSearchParams(location.search); // ?lift=&view=&what=&text=&like=&unlike=&threshold=&layer= : a link to a query

// The key, if the service wants one. Links and <img> cannot send it, so everything is fetched here.
const KEY = "splatlift-key";

async function get(path) {
  const key = sessionStorage.getItem(KEY);
  const reply = await fetch(path, key ? { headers: { Authorization: `Bearer ${key}` } } : {});
  if (reply.ok) return reply;
  if (reply.status === 401) at("door").hidden = false;
  throw await reply.json();
}

const json = async path => (await get(path)).json();

// A picture of the service, whole; its address is to be freed when nobody shows it any more.
async function fetched(path) {
  const picture = new Image();
  picture.src = URL.createObjectURL(await (await get(path)).blob());
  await picture.decode();
  return picture;
}

function hang(name, picture) {
  URL.revokeObjectURL(at(name).src);
  at(name).src = picture.src;
}

function useKey(secret) {
  if (secret) sessionStorage.setItem(KEY, secret); else sessionStorage.removeItem(KEY);
  location.reload(); // nothing of what another key showed stays
}

// Errors are shown as the problem says them.
const words = problem => problem.detail ? `${problem.title}: ${problem.detail}` : `No answer: ${problem.message || problem}`;

function trouble(problem) {
  at("trouble").hidden = !problem;
  at("trouble").textContent = problem ? words(problem) : "";
}

// Text and elements only: what users named never becomes markup.
function row(cells) {
  const line = document.createElement("tr");
  for (const cell of cells) line.insertCell().append(cell);
  return line;
}

function table(id, rows, empty) {
  at(id).replaceChildren(...(rows.length ? rows : [row([empty])]));
}

function link(href, text) {
  const anchor = document.createElement("a");
  anchor.href = href;
  anchor.textContent = text;
  anchor.addEventListener("click", event => {
    if (!sessionStorage.getItem(KEY)) return;
    event.preventDefault();
    follow(href).catch(trouble);
  });
  return anchor;
}

// What a link leads to, when it takes a key: shown if it is JSON, else saved.
async function follow(href) {
  const reply = await get(href);
  const name = /filename="([^"]+)"/.exec(reply.headers.get("Content-Disposition") || "");
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(await reply.blob());
  if (name) anchor.download = name[1]; else anchor.target = "_blank";
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 60000);
}

function brief(counts) {
  return Object.entries(counts).filter(([, value]) => ["number", "string"].includes(typeof value))
    .map(([name, value]) => `${name} ${value.toLocaleString()}`).join(", ");
}

function planned({ summary, warnings }) {
  const list = document.createElement("ul");
  list.className = "plan";
  for (const line of [...summary, ...warnings.map(warning => `warning: ${warning}`)]) {
    const item = document.createElement("li");
    item.textContent = line;
    list.append(item);
  }
  return list;
}

function progress(job) {
  const cell = document.createElement("div");
  const step = job.progress;
  if (job.problem) {
    cell.className = "bad";
    cell.textContent = words(job.problem);
  } else if (job.state === "running" && step) {
    const bar = document.createElement("progress");
    bar.max = step.total;
    bar.value = step.done;
    const left = step.eta_s == null ? "" : `, ${Math.ceil(step.eta_s)} s left in this stage`;
    const parts = step.total > 1 ? ` ${step.done}/${step.total} ${step.unit}` : "";
    cell.append(bar, ` ${step.stage}${parts}${left}`);
    if (job.plan) cell.append(planned(job.plan));
  } else if (job.ended && job.started) {
    cell.textContent = `took ${(job.ended - job.started).toFixed(1)} s`;
    if (job.links.chart) cell.append(": ", link(job.links.chart, "chart"), ", ", link(job.links.tradeoff, "figures"));
  }
  return cell;
}

function fill(select, options) {
  const before = select.value;
  select.replaceChildren(...options.map(([value, label]) => new Option(label, value)));
  if (options.some(([value]) => value === before)) select.value = before;
}

// Examples for and against: pixels that were clicked, or what was typed.
let picks = [];

function pick(example, unlike) {
  if (picks.some(known => known.example === example && known.unlike === unlike)) return;
  picks.push({ example, unlike });
  look();
}

function showPicks() {
  at("picks").replaceChildren(...picks.map((known, place) => {
    const item = document.createElement("li");
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = `${known.unlike ? "unlike" : "like"} ${known.example} \u00d7`;
    button.addEventListener("click", () => { picks.splice(place, 1); look(); });
    item.append(button);
    return item;
  }));
  for (const old of document.querySelectorAll("#stage .point")) old.remove();
  const { naturalWidth: width, naturalHeight: height } = at("render");
  const here = `${at("view").value}:`;
  for (const known of picks) {
    const place = /^(\d+),(\d+)$/.exec(known.example.startsWith(here) ? known.example.slice(here.length) : "");
    if (!place || !width) continue;
    const point = document.createElement("span");
    point.className = known.unlike ? "point unlike" : "point";
    point.style.left = `${100 * (Number(place[1]) + 0.5) / width}%`;
    point.style.top = `${100 * (Number(place[2]) + 0.5) / height}%`;
    at("stage").append(point);
  }
}

function clicked(event) {
  const picture = at("render");
  const box = picture.getBoundingClientRect();
  if (!picture.naturalWidth || !box.width) return;
  const x = Math.floor((event.clientX - box.left) / box.width * picture.naturalWidth);
  const y = Math.floor((event.clientY - box.top) / box.height * picture.naturalHeight);
  if (x < 0 || y < 0 || x >= picture.naturalWidth || y >= picture.naturalHeight) return;
  pick(`${at("view").value}:${x},${y}`, event.shiftKey);
}

function typed(unlike) {
  const example = at("example").value.trim();
  if (!example) return;
  at("example").value = "";
  pick(example, unlike);
}

const settings = job => {
  const asked = job.kind === "tradeoff" ? `trade-off within ${job.parameters.budget_s} s` : job.settings.preset || "";
  return `${asked}, attempt ${job.attempt}`;
};
let lifts = [];
const named = new Map(); // names of a cameras asset's views; an asset never changes

async function namesOf(asset) { // in pages: an asset's counts leave very many names out
  const names = [];
  for (let next = 0; next !== null;) {
    const page = await json(`/assets/${asset}/names?cursor=${next}`);
    names.push(...page.names);
    next = page.next;
  }
  return names;
}

async function viewsOf(lift) {
  try {
    if (!named.has(lift.cameras)) named.set(lift.cameras, await namesOf(lift.cameras));
    return named.get(lift.cameras);
  } catch {
    return lift.views;
  }
}

async function fillViews() {
  const lift = lifts.find(found => found.id === at("lift").value);
  const names = lift ? await viewsOf(lift) : [];
  if (lift && lift.id !== at("lift").value) return; // another one was chosen meanwhile
  const wordless = Boolean(lift) && lift.text_space === "none";
  at("wordless").hidden = !wordless;
  at("text").disabled = wordless;
  fill(at("view"), names.map(name => [name, lift.views.includes(name) ? name : `${name} (not lifted)`]));
}

async function newLifts(found) {
  lifts = found;
  at("none").hidden = lifts.length > 0;
  fill(at("lift"), lifts.map(l => [l.id, `${l.id.slice(0, 8)}: ${l.count.toLocaleString()} splats, ${l.channels} channels`]));
  await fillViews();
  table("lifts", lifts.map(l => row([
    link(l.links.self, l.id.slice(0, 8)), l.count.toLocaleString(), String(l.channels), String(l.views.length),
    l.text_space || "none", link(l.links.features, `${(l.bytes / 1e6).toFixed(1)} MB`),
  ])), "none yet");
}

let first = true;

async function refresh() {
  try {
    const [assets, jobs, done] = await Promise.all([json("/assets"), json("/jobs"), json("/lifts")]);
    table("assets", assets.assets.map(a =>
      row([a.kind, brief(a.counts), a.bytes.toLocaleString(), a.warnings.join("; ")])), "none yet");
    table("jobs", jobs.jobs.map(j => row([link(j.links.self, j.id.slice(0, 8)), j.state, progress(j), settings(j)])), "none yet");
    if (first || String(done.lifts.map(l => l.id)) !== String(lifts.map(l => l.id))) await newLifts(done.lifts);
    if (first) await begin();
    first = false;
  } catch (problem) {
    trouble(problem);
    if (problem.status === 401) return; // until there is a key
  }
  setTimeout(refresh, 2000);
}

// The mask as a veil over what was not found, so that what was found keeps its colours.
async function drawMask(url) {
  const picture = await fetched(url);
  const canvas = at("mask");
  canvas.width = picture.naturalWidth;
  canvas.height = picture.naturalHeight;
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(picture, 0, 0);
  const pixels = context.getImageData(0, 0, canvas.width, canvas.height);
  for (let i = 0; i < pixels.data.length; i += 4) {
    const found = pixels.data[i] > 127;
    pixels.data.fill(0, i, i + 3);
    pixels.data[i + 3] = found ? 0 : 255;
  }
  context.putImageData(pixels, 0, 0);
  URL.revokeObjectURL(picture.src);
}

function arrange() {
  for (const name of ["attention", "mask"]) {
    at(name).hidden = !at(`show-${name}`).checked || !at(name).dataset.ready;
    at(name).style.opacity = at("strength").value / 100;
  }
}

function number(value) {
  return typeof value === "number" ? value.toPrecision(4) : "none";
}

function tell(found) {
  const cut = found.threshold.value == null ? "" : ` at or above ${number(found.threshold.value)}`;
  at("answer").textContent = `${found.count.toLocaleString()} splats${cut}. ${found.threshold.explanation}`;
  const facts = [["threshold", `${number(found.threshold.value)} (${found.threshold.method})`]];
  if (found.top.length) facts.push(["best splat", `${found.top[0].splat}, score ${number(found.top[0].score)}`]);
  for (const name of ["min", "q05", "q50", "q95", "max"]) facts.push([`score ${name}`, number(found.statistics[name])]);
  at("numbers").replaceChildren(...rows(facts));
}

function rows(facts) {
  return facts.flatMap(([name, value]) => {
    const term = document.createElement("dt");
    const told = document.createElement("dd");
    term.textContent = name;
    told.textContent = value;
    return [term, told];
  });
}

async function tellObjects(url, mine) {
  const facts = [];
  try {
    const { objects, strays } = await json(url);
    objects.forEach(({ splats, centre, box }, place) => {
      const sides = box.high.map((high, axis) => number(high - box.low[axis]));
      facts.push([`object ${place + 1}`,
        `${splats.toLocaleString()} splats around (${centre.map(number).join(", ")}), ${sides.join(" x ")}`]);
    });
    if (strays) facts.push(["strays", `${strays.toLocaleString()} splats, in none of them`]);
  } catch (problem) {
    facts.push(["objects", problem.message]);
  }
  if (mine === turn) at("numbers").append(...rows(facts));
}

function clear() {
  for (const name of ["attention", "mask"]) delete at(name).dataset.ready;
  at("answer").textContent = "";
  at("numbers").replaceChildren();
}

let turn = 0; // of the last question: an answer to an older one is late and is dropped

async function look() {
  const mine = ++turn;
  trouble(null);
  clear();
  at("asked").hidden = !at("lift").value;
  if (!at("lift").value) return;
  const place = { lift: at("lift").value, view: at("view").value };
  fetched(`/render?${new URLSearchParams({ ...place, what: at("what").value })}`)
    .then(picture => mine === turn ? hang("render", picture) : URL.revokeObjectURL(picture.src))
    .catch(problem => { if (mine === turn) trouble(problem); });
  arrange();
  showPicks();
  const text = at("text").disabled ? "" : at("text").value.trim();
  if (!text && !picks.some(known => !known.unlike)) return;
  const asked = new URLSearchParams({ ...place, top: 3, threshold: at("threshold").value.trim() || "auto" });
  if (text) asked.append("text", text);
  for (const known of picks) asked.append(known.unlike ? "unlike" : "like", known.example);
  at("answer").textContent = "looking...";
  try {
    const found = await json(`/query?${asked}`);
    if (mine !== turn) return;
    tell(found);
    await drawMask(found.links.mask);
    if (mine !== turn) return;
    at("mask").dataset.ready = "yes";
    arrange();
    const heat = await fetched(found.links.attention);
    if (mine !== turn) return URL.revokeObjectURL(heat.src);
    hang("attention", heat);
    at("attention").dataset.ready = "yes";
    arrange();
    if (found.links.objects) await tellObjects(found.links.objects, mine);
  } catch (problem) {
    if (mine !== turn) return;
    clear();
    trouble(problem);
    const [kind, place] = String(problem.argument).split("."); // like.1 is the second that was sent as like
    const wrong = picks.filter(known => (known.unlike ? "unlike" : "like") === kind)[place];
    picks = picks.filter(known => known !== wrong); // a pixel beside the scene is no example
    showPicks();
  }
}

async function begin() {
  for (const name of ["lift", "view", "what", "text", "threshold"]) {
    if (started.has(name)) at(name).value = started.get(name);
    if (name === "lift") await fillViews();
  }
  for (const name of ["like", "unlike"]) {
    picks.push(...started.getAll(name).map(example => ({ example, unlike: name === "unlike" })));
  }
  if (started.get("layer") === "attention") at("show-attention").checked = !(at("show-mask").checked = false);
  if (!at("view").value && at("view").options.length) at("view").selectedIndex = 0;
  await look();
}

at("host").textContent = location.origin;
at("query").addEventListener("submit", event => { event.preventDefault(); look(); });
at("lift").addEventListener("change", async () => { picks = []; await fillViews(); look(); });
at("stage").addEventListener("click", clicked);
at("render").addEventListener("load", showPicks);
at("more").addEventListener("click", () => typed(false));
at("less").addEventListener("click", () => typed(true));
at("example").addEventListener("keydown", event => { if (event.key === "Enter") typed(event.shiftKey); });
at("view").addEventListener("change", look);
at("what").addEventListener("change", look);
at("door").addEventListener("submit", event => { event.preventDefault(); useKey(at("key").value.trim()); });
at("forget").addEventListener("click", () => useKey(""));
at("door").hidden = !sessionStorage.getItem(KEY);
at("layers").addEventListener("input", arrange);
refresh();
