// Class maps and boxes of CenterNet, a photo at a time.
//   node centernet.cjs NODE_MODULES MODEL_FOLDER PHOTOS MAPS
// PHOTOS: [n, 512, 512, 3] u8. MAPS: of each the maps [128, 128, 80] f32, then the boxes [100, 6] f32.
const fs = require("fs");
const path = require("path");

const [modules, folder, photos, maps] = process.argv.slice(2);
const load = (name) => require(path.join(modules, "@tensorflow", name));
const tf = load("tfjs-core");
const { loadGraphModel } = load("tfjs-converter");
const { setWasmPaths } = load("tfjs-backend-wasm");
const SIDE = 512;

async function main() {
  setWasmPaths(path.join(modules, "@tensorflow", "tfjs-backend-wasm", "dist", path.sep));
  await tf.setBackend("wasm");
  const { modelTopology, weightsManifest } = JSON.parse(fs.readFileSync(path.join(folder, "centernet.json")));
  const weightSpecs = weightsManifest.flatMap((group) => group.weights);
  const weightData = new Uint8Array(fs.readFileSync(path.join(folder, "centernet.bin"))).buffer;
  const network = await loadGraphModel({ load: async () => ({ modelTopology, weightSpecs, weightData }) });
  const pixels = fs.readFileSync(photos);
  const out = fs.openSync(maps, "w");
  for (let start = 0; start < pixels.length; start += SIDE * SIDE * 3) {
    const photo = tf.tensor(Float32Array.from(pixels.subarray(start, start + SIDE * SIDE * 3)), [1, SIDE, SIDE, 3]);
    const found = network.execute(photo, ["tower_0/keypoints", "tower_0/detections"]);
    for (const tensor of found) fs.writeSync(out, new Uint8Array(tensor.dataSync().slice().buffer));
    tf.dispose([photo, ...found]);
  }
}

main();
