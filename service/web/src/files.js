// What a file is, by its name and what is in it: nothing is sent before that is known.
import { unzip, Zip, ZipPassThrough } from "fflate";
import { colmapViews } from "./colmap.js";
import table from "./kinds.json"; // of liftcore.io.kinds: suffixes that are sent, and what others are

const HEADER = 32 << 20; // bytes of a safetensors header that are read here
const TAIL = 1 << 20; // of a zip: its list of names lies at its end
const DEPTH = 5; // folders down
const CAMERAS = new RegExp(table.cameras);
const INRIA = /(^|\/)cameras\.json$/; // which the service reads alone, and of no zip
const PACK = /\.safetensors$/i;
const SOG = /(^|[^\w-])(lod-meta\.json|means_[lu]\.webp)/; // of an unbundled or a streamed one
const READABLE = 512e6; // bytes of a zip whose cameras are read here
const PHOTO = /\.(jpe?g|png)$/i;
const suffix = name => /\.[^.]*$/.exec(name.toLowerCase())?.[0] ?? "";
const isSplats = name => table.kinds[suffix(name)] === "splats";
const either = names => `${names.slice(0, -1).join(", ")}${names.length > 1 ? " or " : ""}${names.at(-1)}`;

// The suffixes of a kind, to be read.
export const suffixes = kind => either(Object.keys(table.kinds).filter(one => table.kinds[one] === kind));

// {kind} of a file, null for what is not sent, with a word on `why` where there is one; a lift file brings what it `needs`:
// [{kind, id, name}]. The server looks at the content, and its answer names a file that is something else.
export async function kindOf(file) {
  const kind = table.kinds[suffix(file.name)] ?? null;
  const other = kind ? null : table.others[suffix(file.name)];
  if (other) return { kind: null, why: other.hint ? `it is ${other.got}: ${other.hint}` : `it is ${other.got}` };
  if (suffix(file.name) === ".zip") return { kind: await zipKind(file) };
  return kind === "features" ? safetensors(file) : { kind };
}

async function zipKind(file) {
  const names = new TextDecoder("latin1").decode(await file.slice(-TAIL).arrayBuffer());
  const has = suffixes => new RegExp(`[^\\x00-\\x1f](${suffixes.map(one => `\\${one}`).join("|")})`, "i").test(names);
  if (/(cameras|images)\.(bin|txt)|transforms[^/]*\.json|cameras\.json/.test(names)) return "cameras";
  if (SOG.test(names)) return "splats";
  if (has(Object.keys(table.kinds).filter(one => table.kinds[one] === "splats"))) return "splats";
  return has(table.images) ? "photos" : "cameras";
}

async function safetensors(file) {
  try {
    const length = Number(new DataView(await file.slice(0, 8).arrayBuffer()).getBigUint64(0, true));
    const { __metadata__: more, ...tensors } = JSON.parse(await file.slice(8, 8 + Math.min(length, HEADER)).text());
    const metadata = more?.splatlift;
    if (!metadata) return { kind: Object.keys(tensors).join() === "embeddings" ? "table" : "features" };
    const { splats, cameras } = JSON.parse(metadata);
    const need = (kind, { sha256, path }) => ({ kind, id: `sha256:${sha256}`, name: path.split(/[\\/]/).at(-1) });
    return { kind: "lift", needs: [need("splats", splats), need("cameras", cameras)] };
  } catch {
    return { kind: "features" }; // the check of the upload says what is wrong with it
  }
}

// What was dropped: files, and of folders the cameras as one zip or as their cameras.json, a SOG's folder as one zip or
// else the newest splats, and the packs; or all files where there is neither. Photos of a folder stay: they may be gigabytes.
export async function dropped({ items, files }) {
  const entries = [...items].map(item => item.webkitGetAsEntry?.()).filter(Boolean); // while the event lasts
  if (!entries.some(entry => entry.isDirectory)) return [...files];
  const found = await Promise.all(entries.map(async entry => {
    const inner = await within(entry);
    const cameras = inner.filter(({ path }) => CAMERAS.test(path));
    const sog = entry.isDirectory ? sogOf(inner.filter(one => !cameras.includes(one))) : [];
    if (!entry.isDirectory || !(cameras.length || sog.length)) return inner.map(({ file }) => file);
    const splats = inner.filter(({ path }) => isSplats(path)).sort((one, other) => other.file.lastModified - one.file.lastModified);
    const packs = inner.filter(({ path }) => PACK.test(path)).map(({ file }) => file);
    return [...(cameras.length ? [cameras.every(({ path }) => INRIA.test(path)) ? cameras.reduce(outer).file : await zipped(cameras, `${entry.name}.zip`)] : []),
      ...(sog.length ? [await zipped(sog, `${entry.name}.sog`)] : splats.slice(0, 1).map(({ file }) => file)), ...packs];
  }));
  return found.flat();
}

// Of two files that which lies higher.
const depth = ({ path }) => path.split("/").length;
const outer = (one, other) => (depth(other) < depth(one) ? other : one);

// The files of a SOG among those of a folder, which may lie deeper in it: paths from where the SOG begins.
function sogOf(parts) {
  const own = parts.filter(({ path }) => SOG.test(path));
  if (!own.length) return [];
  const { path: first } = own.reduce(outer);
  const folder = first.slice(0, first.lastIndexOf("/") + 1);
  return parts.filter(({ path }) => path.startsWith(folder)).map(({ path, file }) => ({ path: path.slice(folder.length), file }));
}

// The files at or below an entry: [{path, file}].
async function within(entry, depth = 0) {
  if (entry.isFile) return [{ path: entry.fullPath.slice(1), file: await new Promise((done, failed) => { entry.file(done, failed); }) }];
  if (depth === DEPTH || entry.name.startsWith(".")) return [];
  const inner = [];
  for (const reader = entry.createReader(); ;) { // a hundred at a time
    const more = await new Promise((done, failed) => { reader.readEntries(done, failed); });
    if (!more.length) break;
    inner.push(...more);
  }
  return (await Promise.all(inner.map(one => within(one, depth + 1)))).flat();
}

async function zipped(parts, name) {
  const content = [];
  const zip = new Zip((_, part) => content.push(part));
  for (const { path, file } of parts) {
    const entry = new ZipPassThrough(path);
    zip.add(entry);
    entry.push(new Uint8Array(await file.arrayBuffer()), true);
  }
  zip.end();
  return new File(content, name);
}

// Photos that were dropped one by one are sent as one zip, without packing them: they are packed already.
export async function gathered(files) {
  const photos = files.filter(file => PHOTO.test(file.name));
  if (!photos.length) return files;
  const name = photos.length > 1 ? `${photos.length} photos.zip` : `${photos[0].name}.zip`;
  return [...files.filter(file => !photos.includes(file)), await zipped(photos.map(file => ({ path: file.name, file })), name)];
}

// The cameras of a file, in the frame of the splats, to be drawn: those of Inria's cameras.json, of transforms.json and of
// a COLMAP model, also in a zip. Others are read by the service alone.
export async function camerasOf(file) {
  try {
    if (/\.zip$/i.test(file.name)) return file.size > READABLE ? [] : await zippedCameras(file);
    return /\.json$/i.test(file.name) ? camerasOfDocument(JSON.parse(await file.text())) : [];
  } catch {
    return []; // the check of the upload says what is wrong with it
  }
}

async function zippedCameras(file) {
  const content = new Uint8Array(await file.arrayBuffer());
  const parts = await new Promise((done, failed) => {
    unzip(content, { filter: ({ name }) => CAMERAS.test(name) && !/dataparser_/.test(name) }, (problem, files) => (problem ? failed(problem) : done(files)));
  });
  const documents = Object.keys(parts).filter(name => name.endsWith(".json"));
  const views = colmapViews(parts);
  return views.length || !documents.length ? views : camerasOfDocument(JSON.parse(new TextDecoder().decode(parts[documents[0]])));
}

function camerasOfDocument(cameras) {
  if (Array.isArray(cameras)) return cameras.filter(one => one.rotation && one.position).map(one => view(one.rotation, one.position, one));
  return (cameras.frames ?? []).map(one => {
    const m = one.transform_matrix;
    const { w, h, fl_x: fx, fl_y: fy } = { ...cameras, ...one };
    return view(m.slice(0, 3).map(row => [row[0], -row[1], -row[2]]), m.slice(0, 3).map(row => row[3]), { width: w, height: h, fx, fy: fy ?? fx });
  }).filter(one => one.fx > 0);
}

// From a camera's axes in the world, as columns, and its place there.
function view(axes, place, { width, height, fx, fy, img_name: name }) {
  const rows = [0, 1, 2].map(column => axes.map(row => row[column]));
  return { name, width, height, fx, fy, viewmat: [...rows.map(row => [...row, -row.reduce((sum, value, axis) => sum + value * place[axis], 0)]), [0, 0, 0, 1]] };
}

// Names of files, which the service does not keep: this browser does, the last ones.
const NAMED = 300; // files and jobs whose names are kept
const NAMES = "splatlift-names";
const names = () => { try { return JSON.parse(localStorage.getItem(NAMES)) ?? {}; } catch { return {}; } };
export const named = id => names()[id];

export function remember(id, name) {
  if (!name) return;
  try {
    localStorage.setItem(NAMES, JSON.stringify(Object.fromEntries([...Object.entries(names()).filter(([known]) => known !== id), [id, name]].slice(-NAMED))));
  } catch { /* a browser that keeps nothing */ }
}
