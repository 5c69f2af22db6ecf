// The scene in 3D: three.js and Spark draw the splats.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { still } from "./dom.js";
import { Painter } from "./painter.js";

const ROW = 32; // bytes of a splat in a .splat file
export const MOST = 2_000_000; // splats that are drawn; of larger scenes every n-th is
const FLIGHT = 700; // ms
const LOADING = 60_000; // ms that the unpacking of a scene may take before the page says so
const SAMPLE = 200_000; // splats among which middles are looked for
const OPAQUE = 40; // of 255: fainter splats are not what somebody points at
const FEWEST = 10_000; // splats that are drawn while something moves, however slow the machine is
const SMOOTH = 60; // ms that a frame may take while something moves
const REST = 250; // ms after the last change, until all splats are drawn
const FRAMES = 4; // of which the fastest tells how fast the machine is: one may have been held up
const WIDEST = 2; // times a splat's size, where it stands for others
const COARSE = 0.5; // pixels a CSS pixel, where fewer splats are drawn
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i; // renderers without a GPU

export function webgl() {
  try {
    return Boolean(document.createElement("canvas").getContext("webgl2"));
  } catch {
    return false;
  }
}

export class Viewer {
  // canvas: to draw on. seen: called after each frame with a function from a point of the world to its place in CSS pixels.
  constructor(canvas, seen) {
    this.canvas = canvas;
    this.seen = seen;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(fine());
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
    this.moved = () => {};
    this.control();
    this.boxes = new THREE.Group();
    this.scene.add(this.boxes);
    this.middle = new THREE.Vector3();
    this.origin = [0, 0, 0];
    this.reach = 1;
    this.spark = new SparkRenderer({
      renderer: this.renderer, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, maxStdDev: 3, minAlpha: 1 / 255,
      onDirty: () => this.draw(false),
    });
    this.scene.add(this.spark);
    this.frames = 0;
    const gl = this.renderer.getContext();
    const named = gl.getExtension("WEBGL_debug_renderer_info");
    this.speeds = SOFTWARE.test(gl.getParameter(named ? named.UNMASKED_RENDERER_WEBGL : gl.RENDERER)) ? [FEWEST] : [Infinity];
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.frame();
    this.draw();
  }

  // Controls turn about the up vector that the camera has when they are made: another one needs others.
  control() {
    const target = this.controls?.target;
    this.controls?.dispose();
    const controls = this.controls = new OrbitControls(this.camera, this.canvas);
    if (target) controls.target.copy(target);
    controls.enableDamping = !still();
    controls.dampingFactor = 0.12;
    controls.zoomToCursor = true;
    controls.addEventListener("change", () => this.draw());
    controls.addEventListener("start", () => { this.flight = null; this.steered = true; this.lead(); });
    controls.addEventListener("end", () => this.moved());
  }

  upright(up) {
    if (this.camera.up.equals(up)) return;
    this.camera.up.copy(up);
    this.control();
  }

  // One camera for two viewers: the one that was moved last leads.
  pair(partner) {
    this.partner = partner;
    partner.partner = this;
    this.lead();
    this.draw();
  }

  lead() {
    if (!this.partner) return;
    this.leads = true;
    this.partner.leads = false;
  }

  // Another viewer's camera, in this one's frame.
  follow({ camera, controls, lens, origin }) {
    const shift = new THREE.Vector3(...origin.map((value, axis) => value - this.origin[axis]));
    const [position, target] = [camera.position.clone().add(shift), controls.target.clone().add(shift)];
    if (position.equals(this.camera.position) && target.equals(this.controls.target) && lens === this.lens && camera.up.equals(this.camera.up)) return;
    this.flight = null;
    this.upright(camera.up);
    this.camera.position.copy(position);
    this.controls.target.copy(target);
    this.lens = lens;
    this.frame();
    this.draw();
  }

  background(colour) {
    this.renderer.setClearColor(new THREE.Color(colour), 1);
    this.draw();
  }

  // changed: by somebody, not by a sort that ended. A slow machine draws some of the splats then, and all of them at rest.
  draw(changed = true) {
    if (changed && this.mesh) {
      const some = Math.min(this.count, Math.max(FEWEST, Math.round(Math.max(...this.speeds))));
      this.thin(some);
      this.rest(some < this.count);
    }
    if (this.asked) return;
    this.asked = requestAnimationFrame(now => {
      this.asked = 0;
      this.fly(now);
      this.controls.update();
      if (this.leads) this.partner.follow(this);
      this.render();
      if (this.flight) this.draw();
    });
  }

  // All splats, a while after the last change is on the screen.
  rest(some) {
    clearTimeout(this.resting);
    this.resting = some && setTimeout(() => {
      if (this.asked || this.timing || this.spark.sorting || this.spark.sortDirty) return this.rest(true);
      this.resting = 0;
      this.thin(this.count);
      return this.draw(false);
    }, REST);
  }

  // The first so many splats, in their order of drawing, wider as they stand for the others.
  thin(number) {
    const { packedSplats } = this.mesh;
    if (packedSplats.numSplats === number) return;
    packedSplats.numSplats = number;
    this.painter.widen(Math.min(WIDEST, Math.sqrt(this.count / number)));
    this.mesh.updateVersion();
  }

  // Until so many splats as are to be drawn are sorted, what is on the screen stays. Spark sorts the first ones right only
  // in a frame of its own.
  render() {
    const { spark, scene, camera, mesh } = this;
    if (mesh && spark.display.numSplats && spark.display.numSplats !== mesh.packedSplats.numSplats) {
      camera.updateMatrixWorld();
      spark.dirty = false; // or it does not say when they are
      spark.updateInternal({ scene, camera, autoUpdate: true });
      return;
    }
    const begun = performance.now();
    const ratio = mesh && spark.display.numSplats < this.count ? COARSE : fine();
    if (this.renderer.getPixelRatio() !== ratio) this.renderer.setPixelRatio(ratio);
    this.renderer.render(scene, camera);
    this.frames += 1;
    this.seen(point => this.place(point));
    if (mesh) this.time(spark.display.numSplats, begun);
  }

  // Splats that are drawn smoothly, by what those of a frame took.
  async time(number, begun) {
    if (this.timing) return;
    this.timing = true;
    await this.drawn().finally(() => { this.timing = false; });
    this.speeds = [...this.speeds.slice(1 - FRAMES), number * SMOOTH / (performance.now() - begun)];
  }

  // Whether all that was asked for is on the screen.
  get settled() {
    const { activeSplats, sorting, sortDirty, dirty } = this.spark;
    return Boolean(this.mesh) && !this.asked && !this.flight && !this.resting && this.spark.display.numSplats === this.count && activeSplats > 0 && !sorting && !sortDirty && !dirty;
  }

  // Once the GPU has drawn all commands.
  async drawn() {
    const gl = this.renderer.getContext();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise(later => setTimeout(later, 8));
    gl.deleteSync(fence);
  }

  // A point of the lift's frame in that of the splats, which are about an origin, and back: cards compute in float32.
  local(point) {
    return new THREE.Vector3(...point.map((value, axis) => value - this.origin[axis]));
  }

  world(point) {
    return point.map((value, axis) => value + this.origin[axis]);
  }

  // A view of the lift's frame among the splats.
  pose({ viewmat }) {
    return poseOf(viewmat.slice(0, 3).map(row => [...row.slice(0, 3), row[3] + along(row, this.origin)]));
  }

  place(point) {
    const there = this.local(point).project(this.camera);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return { x: (there.x + 1) / 2 * width, y: (1 - there.y) / 2 * height, before: there.z < 1 };
  }

  // Show the rows of a .splat file.
  async load(content) {
    this.clear();
    this.total = content.length / ROW;
    const step = Math.ceil(this.total / MOST);
    this.rows = null;
    if (this.total > FEWEST) {
      this.rows = spread(Math.floor(this.total / step), step);
      const whole = content.byteOffset % 4 ? content.slice() : content;
      const words = new Uint32Array(whole.buffer, whole.byteOffset, whole.length / 4);
      const drawn = new Uint32Array(this.rows.length * ROW / 4);
      for (let place = 0; place < drawn.length; place += 1) drawn[place] = words[place % 8 + 8 * this.rows[place >> 3]];
      content = new Uint8Array(drawn.buffer);
    }
    this.count = content.length / ROW;
    if (content.byteOffset % 4) content = content.slice();
    this.bytes = content;
    this.floats = new Float32Array(content.buffer, content.byteOffset, content.length / 4);
    const mesh = new SplatMesh({ fileBytes: content.slice(), fileName: "scene.splat", lod: false });
    let timer;
    await Promise.race([mesh.initialized, new Promise((_, reject) => {
      timer = setTimeout(() => reject({ title: "The splats are not shown in 3D", detail: "this browser takes too long to unpack them; the photo view needs none" }), LOADING);
    })]).finally(() => clearTimeout(timer));
    this.painter = new Painter(this.count, this.rows);
    mesh.objectModifiers = [this.painter.modifier];
    mesh.updateGenerator();
    this.mesh = mesh;
    this.scene.add(mesh);
    this.measure();
    this.steered = false;
    this.paint([]);
  }

  // Splats of a file as it was dropped, before they are lifted, with the cameras that came with them.
  async preview(content, name, views) {
    this.clear();
    const mesh = new SplatMesh({ fileBytes: content, fileName: name, lod: false });
    await mesh.initialized;
    const centres = [];
    mesh.forEachSplat((_, centre) => { centres.push(centre.x, centre.y, centre.z, 0, 0, 0, 0, 0); });
    Object.assign(this, { origin: [0, 0, 0], draft: mesh, floats: centres, count: centres.length / 8 });
    this.scene.add(mesh);
    this.measure();
    this.frusta(views);
    if (views.length) {
      this.settle(views);
      this.to(views[0], true);
    } else {
      this.upright(new THREE.Vector3(0, -1, 0));
      this.camera.position.copy(this.middle).add(new THREE.Vector3(0, -0.6, -2.4).multiplyScalar(this.reach));
      this.controls.target.copy(this.middle);
    }
    this.draw();
  }

  // The outlines of what cameras see, from where they stand.
  frusta(views) {
    const points = [];
    for (const view of views) {
      const { position, right, up, forward } = this.pose(view);
      const far = this.reach / 6;
      const corners = [[-1, -1], [1, -1], [1, 1], [-1, 1]].map(([x, y]) => position.clone().addScaledVector(forward, far)
        .addScaledVector(right, x * far * view.width / 2 / view.fx).addScaledVector(up, y * far * view.height / 2 / view.fy));
      corners.forEach((corner, place) => points.push(position, corner, corner, corners[(place + 1) % 4]));
    }
    this.cones = new THREE.LineSegments(new THREE.BufferGeometry().setFromPoints(points), new THREE.LineBasicMaterial({ color: 0xffb84d, depthTest: false, transparent: true, opacity: 0.7 }));
    this.cones.renderOrder = 10;
    this.scene.add(this.cones);
  }

  clear() {
    if (this.draft) {
      this.scene.remove(this.draft, this.cones);
      this.draft.dispose();
      this.cones.geometry.dispose();
      this.draft = null;
    }
    clearTimeout(this.resting);
    this.resting = 0;
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
      this.painter.dispose();
      this.mesh = null;
    }
    this.outline([]);
  }

  // The middle of the scene and its reach, by the middle half of a sample on each axis: floaters count for nothing.
  measure() {
    const every = Math.max(1, Math.floor(this.count / 5000));
    const axes = [[], [], []];
    for (let row = 0; row < this.count; row += every) for (let axis = 0; axis < 3; axis += 1) axes[axis].push(this.floats[row * 8 + axis]);
    const ends = axes.map(values => values.sort((a, b) => a - b)).map(v => [v[Math.floor(v.length / 4)], v[Math.floor(v.length / 2)], v[Math.floor(3 * v.length / 4)]]);
    this.middle = new THREE.Vector3(...ends.map(end => end[1]));
    this.reach = Math.max(...ends.map(end => end[2] - end[0]), 1e-6);
    this.camera.near = this.reach / 500;
    this.camera.far = this.reach * 500;
    this.camera.updateProjectionMatrix();
  }

  // The row of the file that is drawn at a place.
  row(place) {
    return this.rows ? this.rows[place] : place;
  }

  // Colours of what is asked, as `Painter` has it.
  paint(questions, how) {
    this.painter.paint(questions, how);
    this.mesh.updateVersion();
    this.draw();
  }

  // Which way is up, and what all the views look at. Cameras are seldom rolled: up is the mean of their own, but for
  // what of it lies along their horizontal axes. The focus is the point nearest to their lines of sight.
  settle(views) {
    const poses = views.map(view => this.pose(view));
    const mean = poses.reduce((sum, pose) => sum.add(pose.up), new THREE.Vector3());
    this.up = mean.applyMatrix3(outer(poses.map(pose => pose.right), 1, 0.002 * poses.length).invert()).normalize();
    if (this.up.lengthSq() < 0.5) this.up.set(0, 0, 1);
    this.upright(this.up);
    const across = outer(poses.map(pose => pose.forward), -1, poses.length); // sum of I - d d^T
    const side = poses.reduce((sum, { position, forward }) => sum.add(position).addScaledVector(forward, -position.dot(forward)), new THREE.Vector3());
    const found = Math.abs(across.determinant()) > 1e-6 * poses.length ** 3 ? side.applyMatrix3(across.invert()) : null;
    const inFront = found && poses.filter(pose => found.clone().sub(pose.position).dot(pose.forward) > 0).length > poses.length / 2;
    this.focused = Boolean(inFront);
    this.focus = inFront ? found : this.middle.clone();
  }

  // Angles of view: a photo is shown whole, whatever the window's shape.
  frame() {
    const { halfWidth, halfHeight } = this.lens || { halfWidth: 0.5, halfHeight: 0.5 };
    this.camera.fov = 2 * Math.atan(Math.max(halfHeight, halfWidth / this.camera.aspect)) * 180 / Math.PI;
    this.camera.updateProjectionMatrix();
  }

  to(view, quick) {
    const pose = this.pose(view);
    const depth = this.focus.clone().sub(pose.position).dot(pose.forward);
    const target = pose.position.clone().addScaledVector(pose.forward, depth > 0 ? depth : this.reach);
    this.lens = { halfWidth: view.width / 2 / view.fx, halfHeight: view.height / 2 / view.fy };
    this.frame();
    this.go(pose.position, target, quick);
  }

  // Look at a box or a point: from where one is, or from a view that shows it. That view itself shows a box which no
  // picture nearer by would hold.
  toBox({ low, high }, view = null) {
    const box = new THREE.Box3(this.local(low), this.local(high));
    const sphere = box.getBoundingSphere(new THREE.Sphere());
    const away = view ? this.pose(view).position.sub(sphere.center) : this.camera.position.clone().sub(this.controls.target);
    const angle = this.camera.fov * Math.PI / 360;
    const far = 1.9 * Math.max(sphere.radius, this.reach / 100) / Math.sin(Math.min(angle, Math.atan(Math.tan(angle) * this.camera.aspect)));
    if (view && far > away.length()) return this.to(view);
    this.go(sphere.center.clone().addScaledVector(away.normalize(), far), sphere.center);
  }

  toPoint(point) {
    const back = this.camera.position.clone().sub(this.controls.target);
    const near = 0.6 * this.camera.position.distanceTo(point);
    this.go(point.clone().addScaledVector(back.normalize(), near), point);
  }

  go(position, target, quick = still()) {
    this.lead();
    if (quick) {
      this.flight = null;
      this.camera.position.copy(position);
      this.controls.target.copy(target);
      this.moved();
    } else {
      const from = { position: this.camera.position.clone(), target: this.controls.target.clone() };
      this.flight = { from, position: position.clone(), target: target.clone(), begun: 0 };
    }
    this.draw();
  }

  fly(now) {
    const flight = this.flight;
    if (!flight) return;
    flight.begun ||= now;
    const share = Math.min(1, (now - flight.begun) / FLIGHT);
    const eased = share * share * (3 - 2 * share);
    this.controls.target.lerpVectors(flight.from.target, flight.target, eased);
    this.camera.position.lerpVectors(flight.from.position, flight.position, eased);
    if (share === 1) {
      this.flight = null;
      this.moved();
    }
  }

  // By keyboard: turn by angles in radians, zoom by a factor.
  turn(around, over) {
    this.steered = true;
    this.lead();
    const offset = this.camera.position.clone().sub(this.controls.target);
    const turned = new THREE.Quaternion().setFromUnitVectors(this.camera.up, new THREE.Vector3(0, 1, 0));
    const place = new THREE.Spherical().setFromVector3(offset.applyQuaternion(turned));
    place.theta += around;
    place.phi += over;
    place.makeSafe();
    offset.setFromSpherical(place).applyQuaternion(turned.invert());
    this.camera.position.copy(this.controls.target).add(offset);
    this.moved();
    this.draw();
  }

  zoom(factor) {
    this.steered = true;
    this.lead();
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.moved();
    this.draw();
  }

  get place3d() {
    return [...this.camera.position.toArray(), ...this.controls.target.toArray()];
  }

  // What lies under a place of the canvas: the splat nearest to where the ray ends, and that point. null: nothing.
  pick(x, y) {
    if (!this.mesh) return null;
    this.mesh.context.numSplats.value = this.count; // also where fewer are drawn
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2(2 * x / width - 1, 1 - 2 * y / height), this.camera);
    const hit = ray.intersectObject(this.mesh)[0];
    if (!hit) return null;
    const { x: px, y: py, z: pz } = hit.point;
    let best = -1;
    let least = Infinity;
    for (let place = 0; place < this.count; place += 1) {
      const dx = this.floats[8 * place] - px;
      const dy = this.floats[8 * place + 1] - py;
      const dz = this.floats[8 * place + 2] - pz;
      const far = dx * dx + dy * dy + dz * dz;
      if (far < least && this.bytes[ROW * place + 27] >= OPAQUE) {
        least = far;
        best = place;
      }
    }
    return best < 0 ? null : { splat: this.row(best), point: hit.point, at: this.world(hit.point.toArray()) };
  }

  // The middle of the splats of each value, from a value a row of the file: medians, as strays count for nothing.
  centres(values, most) {
    const rows = Array.from({ length: most + 1 }, () => []);
    const every = Math.max(1, Math.floor(this.count / SAMPLE));
    for (let place = 0; place < this.count; place += every) rows[values[this.row(place)]].push(place);
    return rows.map(places => (places.length ? this.world([0, 1, 2].map(axis => {
      const sorted = places.map(place => this.floats[8 * place + axis]).sort((a, b) => a - b);
      return sorted[sorted.length >> 1];
    })) : null));
  }

  // This camera as the service draws it, in a picture so many pixels wide at most.
  own(most) {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    const width = Math.min(clientWidth, most);
    const height = Math.round(clientHeight * width / clientWidth);
    this.camera.lookAt(this.controls.target); // the controls do it before the next frame
    this.camera.updateMatrixWorld();
    const m = this.camera.matrixWorldInverse.elements; // column by column, OpenGL's axes
    const viewmat = [0, 1, 2, 3].map(row => [0, 1, 2, 3].map(column => (row === 1 || row === 2 ? -1 : 1) * m[4 * column + row]));
    for (const row of viewmat.slice(0, 3)) row[3] -= along(row, this.origin);
    return { width, height, fx: height / 2 / Math.tan(this.camera.fov * Math.PI / 360), viewmat };
  }

  // Boxes of things: [{low, high, colour, strong}].
  outline(boxes) {
    for (const line of this.boxes.children) line.geometry.dispose();
    this.boxes.clear();
    for (const { low, high, colour, strong } of boxes) {
      const box = new THREE.Box3(this.local(low), this.local(high));
      const line = new THREE.Box3Helper(box, new THREE.Color(colour));
      Object.assign(line.material, { depthTest: false, transparent: true, opacity: strong ? 1 : 0.45 });
      line.renderOrder = 10;
      this.boxes.add(line);
    }
    this.draw();
  }

  // The canvas, once all splats are on it.
  async whole() {
    while (this.mesh && !this.settled) await new Promise(later => setTimeout(later, 50));
    this.renderer.render(this.scene, this.camera);
    return this.canvas;
  }
}

const fine = () => Math.min(devicePixelRatio, 1.5);

// Every so many rows, in an order whose first ones, however many, are spread evenly over all: steps of the golden ratio.
function spread(count, step) {
  const common = (one, other) => (other ? common(other, one % other) : one);
  let stride = Math.round(count * (Math.sqrt(5) - 1) / 2);
  while (common(count, stride) > 1) stride += 1;
  const rows = new Uint32Array(count);
  for (let place = 0; place < count; place += 1) rows[place] = place * stride % count * step;
  return rows;
}

// OpenCV's axes: x right, y down, z forward.
function poseOf(m) {
  const position = new THREE.Vector3(...[0, 1, 2].map(axis => -(m[0][axis] * m[0][3] + m[1][axis] * m[1][3] + m[2][axis] * m[2][3])));
  return { position, right: new THREE.Vector3(m[0][0], m[0][1], m[0][2]), forward: new THREE.Vector3(m[2][0], m[2][1], m[2][2]), up: new THREE.Vector3(-m[1][0], -m[1][1], -m[1][2]) };
}

// The first three numbers of a row times a point.
function along(row, point) {
  return row[0] * point[0] + row[1] * point[1] + row[2] * point[2];
}

// sign * sum of v v^T + ridge * I, of vectors of the world.
function outer(vectors, sign, ridge) {
  const { elements } = new THREE.Matrix3().multiplyScalar(ridge);
  for (const vector of vectors) {
    const v = vector.toArray();
    for (let place = 0; place < 9; place += 1) elements[place] += sign * v[Math.floor(place / 3)] * v[place % 3];
  }
  return new THREE.Matrix3().fromArray(elements);
}
