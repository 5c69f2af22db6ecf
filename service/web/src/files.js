// What a file is, by its name and what is in it: nothing is sent before that is known.
import { Zip, ZipPassThrough } from "fflate";

const HEADER = 32 << 20; // bytes of a safetensors header that are read here
const TAIL = 1 << 20; // of a zip: its list of names lies at its end
const PHOTO = /\.(jpe?g|png)$/i;

// {kind} of a file, null for what is not known; a lift file brings what it `needs`: [{kind, id, name}].
export async function kindOf(file) {
  if (/\.(ply|splat|spz|sog)$/i.test(file.name)) return { kind: "splats" };
  if (/\.json$/i.test(file.name)) return { kind: "cameras" };
  if (/\.zip$/i.test(file.name)) return { kind: await zipKind(file) };
  if (/\.safetensors$/i.test(file.name)) return safetensors(file);
  return { kind: null };
}

async function zipKind(file) {
  const names = new TextDecoder("latin1").decode(await file.slice(-TAIL).arrayBuffer());
  return /\.(jpe?g|png)/i.test(names) && !/\.(bin|txt|json)/i.test(names) ? "photos" : "cameras";
}

async function safetensors(file) {
  try {
    const length = Number(new DataView(await file.slice(0, 8).arrayBuffer()).getBigUint64(0, true));
    const told = JSON.parse(await file.slice(8, 8 + Math.min(length, HEADER)).text()).__metadata__?.splatlift;
    if (!told) return { kind: "features" };
    const { splats, cameras } = JSON.parse(told);
    const need = (kind, { sha256, path }) => ({ kind, id: `sha256:${sha256}`, name: path.split(/[\\/]/).at(-1) });
    return { kind: "lift", needs: [need("splats", splats), need("cameras", cameras)] };
  } catch {
    return { kind: "features" }; // the check of the upload says what is wrong with it
  }
}

// Photos that were dropped one by one are sent as one zip, without packing them: they are packed already.
export async function gathered(files) {
  const photos = files.filter(file => PHOTO.test(file.name));
  if (!photos.length) return files;
  const parts = [];
  const zip = new Zip((_, part) => parts.push(part));
  for (const photo of photos) {
    const entry = new ZipPassThrough(photo.name);
    zip.add(entry);
    entry.push(new Uint8Array(await photo.arrayBuffer()), true);
  }
  zip.end();
  return [...files.filter(file => !photos.includes(file)), new File(parts, photos.length > 1 ? `${photos.length} photos.zip` : `${photos[0].name}.zip`)];
}
