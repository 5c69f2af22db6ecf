// The views of a COLMAP model, binary or text, by COLMAP's documentation: world to camera, x right, y down.
const PARAMETER_COUNTS = [3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16]; // parameters of each camera model, by its number
const MODELS = ["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV", "FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"];
const SINGLE_FOCAL = new Set([0, 2, 3, 8, 9]); // models whose first parameter is both focal lengths
const POINT_BYTES = 24; // bytes of a point in images.bin

// The views of files, contents by path: those of the first complete model, by the order of paths.
export function colmapViews(files) {
  for (const path of Object.keys(files).filter(name => /(^|\/)images\.(bin|txt)$/.test(name)).sort()) {
    const [folder, ending] = [path.slice(0, path.lastIndexOf("/") + 1), path.slice(-3)];
    const cameras = files[`${folder}cameras.${ending}`];
    if (cameras) return ending === "bin" ? binary(files[path], cameras) : text(files[path], cameras);
  }
  return [];
}

function camera(model, width, height, parameters) {
  return { width, height, fx: parameters[0], fy: parameters[SINGLE_FOCAL.has(model) ? 0 : 1] };
}

// The 4 x 4 matrix of a quaternion of any length, real part first, and a translation.
function viewmat(quaternion, translation) {
  const length = Math.hypot(...quaternion);
  const [w, x, y, z] = quaternion.map(value => value / length);
  const rows = [
    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
  return [...rows.map((row, axis) => [...row, translation[axis]]), [0, 0, 0, 1]];
}

function binary(images, cameras) {
  const cameraOf = new Map();
  let stream = reader(cameras);
  for (let remaining = stream.u64(); remaining > 0; remaining -= 1) {
    const [id, model, width, height] = [stream.u32(), stream.u32(), stream.u64(), stream.u64()];
    cameraOf.set(id, camera(model, width, height, stream.f64(PARAMETER_COUNTS[model])));
  }
  const views = [];
  stream = reader(images);
  for (let remaining = stream.u64(); remaining > 0; remaining -= 1) {
    stream.u32();
    const [rotation, translation, id, name] = [stream.f64(4), stream.f64(3), stream.u32(), stream.text()];
    stream.skip(POINT_BYTES * stream.u64());
    views.push({ name, ...cameraOf.get(id), viewmat: viewmat(rotation, translation) });
  }
  return views;
}

function text(images, cameras) {
  const lines = content => new TextDecoder().decode(content).split("\n").filter(line => !line.startsWith("#"));
  const cameraOf = new Map(lines(cameras).filter(line => line.trim()).map(line => {
    const [id, model, width, height, ...parameters] = line.trim().split(/\s+/);
    return [id, camera(MODELS.indexOf(model), Number(width), Number(height), parameters.map(Number))];
  }));
  return lines(images).filter((line, index) => index % 2 === 0 && line.trim()).map(line => { // every second line lists points
    const [, w, x, y, z, tx, ty, tz, id, ...name] = line.trim().split(/\s+/);
    return { name: name.join(" "), ...cameraOf.get(id), viewmat: viewmat([w, x, y, z].map(Number), [tx, ty, tz].map(Number)) };
  });
}

function reader(content) {
  const view = new DataView(content.buffer, content.byteOffset, content.byteLength);
  let offset = 0;
  const next = size => { offset += size; return offset - size; };
  return {
    u32: () => view.getUint32(next(4), true),
    u64: () => Number(view.getBigUint64(next(8), true)),
    f64: number => Array.from({ length: number }, () => view.getFloat64(next(8), true)),
    skip: size => { next(size); },
    text: () => {
      const end = content.indexOf(0, offset);
      const name = new TextDecoder().decode(content.subarray(offset, end));
      offset = end + 1;
      return name;
    },
  };
}
