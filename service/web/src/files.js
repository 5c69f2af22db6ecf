// The kind of a file by its name and content, which is known before anything is sent.
import { Zip, ZipPassThrough } from "fflate";
import kindTable from "../kinds.json" with { type: "json" }; // of liftcore.io.kinds: suffixes that are sent, and descriptions of others

const MAX_HEADER_BYTES = 32 << 20; // bytes of a safetensors header that are read here
const ZIP_TAIL_BYTES = 1 << 20; // bytes at the end of a ZIP, where its list of names is
const MAX_DEPTH = 5; // levels of folders
const CAMERAS = new RegExp(kindTable.cameras);
const INRIA = /(^|\/)cameras\.json$/; // which the service reads as a file, not in a ZIP
const PACK = /\.safetensors$/i;
const SOG = /(^|[^\w-])(lod-meta\.json|means_[lu]\.webp)/; // files of an unbundled or streamed SOG
const PHOTO = /\.(jpe?g|png)$/i;
const suffix = name => /\.[^.]*$/.exec(name.toLowerCase())?.[0] ?? "";
const isSplats = name => kindTable.kinds[suffix(name)] === "splats";
const joinNames = names => `${names.slice(0, -1).join(", ")}${names.length > 1 ? " or " : ""}${names.at(-1)}`;

// The suffixes of a kind as text.
export const suffixes = kind => joinNames(Object.keys(kindTable.kinds).filter(ending => kindTable.kinds[ending] === kind));

// The {kind} of a file, null if it cannot be sent, then with a `reason` if one is known. The service checks the content
// again.
export async function kindOf(file) {
  const kind = kindTable.kinds[suffix(file.name)] ?? null;
  const other = kind ? null : kindTable.others[suffix(file.name)];
  if (other) return { kind: null, reason: other.hint ? `it is ${other.got}: ${other.hint}` : `it is ${other.got}` };
  if (suffix(file.name) === ".zip") return { kind: await zipKind(file) };
  return kind === "features" ? safetensors(file) : { kind };
}

async function zipKind(file) {
  const names = new TextDecoder("latin1").decode(await file.slice(-ZIP_TAIL_BYTES).arrayBuffer());
  const has = suffixes => new RegExp(`[^\\x00-\\x1f](${suffixes.map(ending => `\\${ending}`).join("|")})`, "i").test(names);
  if (/(cameras|images)\.(bin|txt)|transforms[^/]*\.json|cameras\.json/.test(names)) return "cameras";
  if (SOG.test(names)) return "splats";
  if (has(Object.keys(kindTable.kinds).filter(ending => kindTable.kinds[ending] === "splats"))) return "splats";
  return has(kindTable.images) ? "photos" : "cameras";
}

async function safetensors(file) {
  try {
    const length = Number(new DataView(await file.slice(0, 8).arrayBuffer()).getBigUint64(0, true));
    const { __metadata__: entries, ...tensors } = JSON.parse(await file.slice(8, 8 + Math.min(length, MAX_HEADER_BYTES)).text());
    return { kind: entries?.splatlift ? "lift" : Object.keys(tensors).join() === "embeddings" ? "table" : "features" };
  } catch {
    return { kind: "features" }; // the check of the upload reports the error
  }
}

// The files of a drop. Of a folder: its cameras as one ZIP or as its cameras.json, its SOG as one ZIP or else its newest
// splats, and its feature packs; all files if it has neither cameras nor a SOG. Photos of a folder are left out, as they
// may be gigabytes.
export async function filesOfDrop({ items, files }) {
  const entries = [...items].map(item => item.webkitGetAsEntry?.()).filter(Boolean); // the list is empty after the event
  if (!entries.some(entry => entry.isDirectory)) return [...files];
  const lists = await Promise.all(entries.map(async entry => {
    const inner = await listFiles(entry);
    const cameras = inner.filter(({ path }) => CAMERAS.test(path));
    const sog = entry.isDirectory ? sogFiles(inner.filter(part => !cameras.includes(part))) : [];
    if (!entry.isDirectory || !(cameras.length || sog.length)) return inner.map(({ file }) => file);
    const splats = inner.filter(({ path }) => isSplats(path)).sort((part, b) => b.file.lastModified - part.file.lastModified);
    const packs = inner.filter(({ path }) => PACK.test(path)).map(({ file }) => file);
    return [...(cameras.length ? [cameras.every(({ path }) => INRIA.test(path)) ? cameras.reduce(shallower).file : await zipFiles(cameras, `${entry.name}.zip`)] : []),
      ...(sog.length ? [await zipFiles(sog, `${entry.name}.sog`)] : splats.slice(0, 1).map(({ file }) => file)), ...packs];
  }));
  return lists.flat();
}

// The one of two files that is nearer to the root.
const depth = ({ path }) => path.split("/").length;
const shallower = (a, b) => (depth(b) < depth(a) ? b : a);

// The files of a SOG among those of a folder, with paths from the folder of the SOG, which may be nested.
function sogFiles(parts) {
  const sogParts = parts.filter(({ path }) => SOG.test(path));
  if (!sogParts.length) return [];
  const { path: topPath } = sogParts.reduce(shallower);
  const folder = topPath.slice(0, topPath.lastIndexOf("/") + 1);
  return parts.filter(({ path }) => path.startsWith(folder)).map(({ path, file }) => ({ path: path.slice(folder.length), file }));
}

// The files at or below an entry: [{path, file}].
async function listFiles(entry, depth = 0) {
  if (entry.isFile) return [{ path: entry.fullPath.slice(1), file: await new Promise((resolve, reject) => { entry.file(resolve, reject); }) }];
  if (depth === MAX_DEPTH || entry.name.startsWith(".")) return [];
  const inner = [];
  for (const reader = entry.createReader(); ;) { // browsers give at most a hundred entries a call
    const batch = await new Promise((resolve, reject) => { reader.readEntries(resolve, reject); });
    if (!batch.length) break;
    inner.push(...batch);
  }
  return (await Promise.all(inner.map(child => listFiles(child, depth + 1)))).flat();
}

async function zipFiles(parts, name) {
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

// Put single photos into one ZIP, without compression, as they are compressed already.
export async function zipPhotos(files) {
  const photos = files.filter(file => PHOTO.test(file.name));
  if (!photos.length) return files;
  const name = photos.length > 1 ? `${photos.length} photos.zip` : `${photos[0].name}.zip`;
  return [...files.filter(file => !photos.includes(file)), await zipFiles(photos.map(file => ({ path: file.name, file })), name)];
}
