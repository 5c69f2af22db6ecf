// The scene in 3D: three.js and Spark draw the splats.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { prefersStill } from "./dom.js";
import { Painter } from "./painter.js";

export const ROW_BYTES = 32; // bytes of a splat in a .splat file
export const MAX_SPLATS = 2_000_000; // drawn splats; of a larger scene every n-th splat is drawn
const FLIGHT_TIME = 700; // ms of a camera flight
const UNPACK_TIMEOUT = 60_000; // ms after which the unpacking of a scene is an error
const SAMPLE_SIZE = 200_000; // splats in the medians of centres
const MIN_PICK_OPACITY = 40; // of 255; fainter splats cannot be picked
const MIN_SPLATS = 10_000; // drawn splats during a motion, without a GPU
const MOVING_SPLATS = 500_000; // drawn splats during a motion, with one
const HORIZON = 0.49 * Math.PI; // radians from the up vector
const REST_DELAY = 250; // ms from the last change to a frame of all splats
const MAX_WIDENING = 2; // largest factor of the size of splats that are drawn for others
const COARSE_RATIO = 0.5; // device pixels per CSS pixel while fewer splats are drawn
const SOFTWARE = /swiftshader|llvmpipe|software|basic render/i; // renderers without a GPU

export function webgl() {
  try {
    return Boolean(document.createElement("canvas").getContext("webgl2"));
  } catch {
    return false;
  }
}

export class Viewer {
  // onFrame(project): called after each frame. project(point): a point of the world in CSS pixels.
  constructor(canvas, onFrame) {
    this.canvas = canvas;
    this.onFrame = onFrame;
    this.renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true, powerPreference: "high-performance" });
    this.renderer.setPixelRatio(pixelRatio());
    this.scene = new THREE.Scene();
    this.camera = new THREE.PerspectiveCamera(50, 1, 0.01, 1000);
    this.onMove = () => {};
    this.lowestAngle = Math.PI;
    this.createControls();
    this.boxes = new THREE.Group();
    this.scene.add(this.boxes);
    this.centre = new THREE.Vector3();
    this.origin = [0, 0, 0];
    this.extent = 1;
    this.spark = new SparkRenderer({
      renderer: this.renderer, preBlurAmount: 0.3, blurAmount: 0, sortRadial: false, maxStdDev: 3, minAlpha: 1 / 255,
      onDirty: () => this.draw(false),
    });
    this.scene.add(this.spark);
    this.frames = 0;
    const gl = this.renderer.getContext();
    const debugInfo = gl.getExtension("WEBGL_debug_renderer_info");
    this.movingSplats = SOFTWARE.test(gl.getParameter(debugInfo ? debugInfo.UNMASKED_RENDERER_WEBGL : gl.RENDERER)) ? MIN_SPLATS : MOVING_SPLATS;
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.updateLens();
    this.draw();
  }

  // OrbitControls read the up vector of the camera once, so a new up vector needs new controls.
  createControls() {
    const target = this.controls?.target;
    this.controls?.dispose();
    const controls = this.controls = new OrbitControls(this.camera, this.canvas);
    if (target) controls.target.copy(target);
    controls.enableDamping = !prefersStill();
    controls.dampingFactor = 0.12;
    controls.zoomToCursor = true;
    controls.maxPolarAngle = this.lowestAngle;
    controls.addEventListener("change", () => this.draw());
    controls.addEventListener("start", () => { this.flight = null; this.isSteered = true; this.takeLead(); });
    controls.addEventListener("end", () => this.onMove());
  }

  upright(up) {
    if (this.camera.up.equals(up)) return;
    this.camera.up.copy(up);
    this.createControls();
  }

  // Share one camera with another viewer: both follow the one that was moved last.
  pair(partner) {
    this.partner = partner;
    partner.partner = this;
    this.takeLead();
    this.draw();
  }

  takeLead() {
    if (!this.partner) return;
    this.isLeading = true;
    this.partner.isLeading = false;
  }

  // Take over the camera of another viewer.
  follow({ camera, controls, lens }) {
    if (camera.position.equals(this.camera.position) && controls.target.equals(this.controls.target) && lens === this.lens && camera.up.equals(this.camera.up)) return;
    this.flight = null;
    this.upright(camera.up);
    this.camera.position.copy(camera.position);
    this.controls.target.copy(controls.target);
    this.lens = lens;
    this.updateLens();
    this.draw();
  }

  background(colour) {
    this.renderer.setClearColor(new THREE.Color(colour), 1);
    this.draw();
  }

  // Request a frame. isChange: false if only a sort has ended. After a change some of the splats are drawn first, and
  // all of them at rest.
  draw(isChange = true) {
    if (isChange && this.mesh) {
      const number = Math.min(this.count, this.movingSplats);
      this.drawFirst(number);
      this.drawAllLater(number < this.count);
    }
    if (this.frameRequest) return;
    this.frameRequest = requestAnimationFrame(now => {
      this.frameRequest = 0;
      this.stepFlight(now);
      this.controls.update();
      if (this.isLeading) this.partner.follow(this);
      this.render();
      if (this.flight) this.draw();
    });
  }

  // Draw all splats once the last change is on the screen and REST_DELAY has passed.
  drawAllLater(isThinned) {
    clearTimeout(this.restTimer);
    this.restTimer = isThinned && setTimeout(() => {
      if (this.frameRequest || this.spark.sorting || this.spark.sortDirty) return this.drawAllLater(true);
      this.restTimer = 0;
      this.drawFirst(this.count);
      return this.draw(false);
    }, REST_DELAY);
  }

  // Draw the first splats alone, widened to fill the gaps of the others.
  drawFirst(number) {
    const { packedSplats } = this.mesh;
    if (packedSplats.numSplats === number) return;
    packedSplats.numSplats = number;
    this.painter.setScale(Math.min(MAX_WIDENING, Math.sqrt(this.count / number)));
    this.mesh.updateVersion();
  }

  // Keep the frame on the screen until Spark has sorted as many splats as are to be drawn; its first sort needs a frame of
  // its own.
  render() {
    const { spark, scene, camera, mesh } = this;
    if (mesh && spark.display.numSplats && spark.display.numSplats !== mesh.packedSplats.numSplats) {
      camera.updateMatrixWorld();
      spark.dirty = false; // else Spark does not call onDirty
      spark.updateInternal({ scene, camera, autoUpdate: true });
      return;
    }
    const ratio = mesh && spark.display.numSplats < this.count ? COARSE_RATIO : pixelRatio();
    if (this.renderer.getPixelRatio() !== ratio) this.renderer.setPixelRatio(ratio);
    this.renderer.render(scene, camera);
    this.frames += 1;
    this.onFrame(point => this.project(point));
  }

  // True if the screen shows the last change with all splats.
  get settled() {
    const { activeSplats, sorting, sortDirty, dirty } = this.spark;
    return Boolean(this.mesh) && !this.frameRequest && !this.flight && !this.restTimer && this.spark.display.numSplats === this.count && activeSplats > 0 && !sorting && !sortDirty && !dirty;
  }

  // Wait until the GPU has finished all commands.
  async gpuDone() {
    const gl = this.renderer.getContext();
    const fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
    while (gl.clientWaitSync(fence, 0, 0) === gl.TIMEOUT_EXPIRED) await new Promise(later => setTimeout(later, 8));
    gl.deleteSync(fence);
  }

  // Points of the lift's frame in that of the drawn splats, and back. Splats are drawn relative to an origin, as GPUs
  // compute in float32.
  toLocal(point) {
    return new THREE.Vector3(...point.map((value, axis) => value - this.origin[axis]));
  }

  toWorld(point) {
    return point.map((value, axis) => value + this.origin[axis]);
  }

  // The camera axes of a view in the frame of the drawn splats.
  pose({ viewmat }) {
    return poseOf(viewmat.slice(0, 3).map(row => [...row.slice(0, 3), row[3] + dotRow(row, this.origin)]));
  }

  project(point) {
    const projected = this.toLocal(point).project(this.camera);
    const { clientWidth: width, clientHeight: height } = this.canvas;
    return { x: (projected.x + 1) / 2 * width, y: (1 - projected.y) / 2 * height, before: projected.z < 1 };
  }

  // Show the rows of a .splat file.
  async load(content) {
    this.clear();
    this.total = content.length / ROW_BYTES;
    const step = Math.ceil(this.total / MAX_SPLATS);
    this.rows = null;
    if (this.total > MIN_SPLATS) {
      this.rows = spreadRows(Math.floor(this.total / step), step);
      const aligned = content.byteOffset % 4 ? content.slice() : content;
      const words = new Uint32Array(aligned.buffer, aligned.byteOffset, aligned.length / 4);
      const subset = new Uint32Array(this.rows.length * ROW_BYTES / 4);
      for (let index = 0; index < subset.length; index += 1) subset[index] = words[index % 8 + 8 * this.rows[index >> 3]];
      content = new Uint8Array(subset.buffer);
    }
    this.count = content.length / ROW_BYTES;
    if (content.byteOffset % 4) content = content.slice();
    this.bytes = content;
    this.floats = new Float32Array(content.buffer, content.byteOffset, content.length / 4);
    const mesh = new SplatMesh({ fileBytes: content.slice(), fileName: "scene.splat", lod: false });
    let timer;
    await Promise.race([mesh.initialized, new Promise((_, reject) => {
      timer = setTimeout(() => reject({ title: "The splats are not shown in 3D", detail: "this browser needs too long to unpack them; use the photo view" }), UNPACK_TIMEOUT);
    })]).finally(() => clearTimeout(timer));
    this.painter = new Painter(this.count, this.rows);
    mesh.objectModifiers = [this.painter.modifier];
    mesh.updateGenerator();
    this.mesh = mesh;
    this.scene.add(mesh);
    this.measureExtent();
    this.isSteered = false;
    this.paint([]);
  }

  // Draw a splat file before it is lifted.
  async showFile(content, name) {
    this.clear();
    const mesh = new SplatMesh({ fileBytes: content, fileName: name, lod: false });
    await mesh.initialized;
    const centres = [];
    mesh.forEachSplat((_, centre) => { centres.push(centre.x, centre.y, centre.z, 0, 0, 0, 0, 0); });
    Object.assign(this, { origin: [0, 0, 0], draft: mesh, floats: centres, count: centres.length / 8 });
    this.scene.add(mesh);
    this.measureExtent();
    this.upright(new THREE.Vector3(0, -1, 0));
    this.camera.position.copy(this.centre).add(new THREE.Vector3(0, -0.6, -2.4).multiplyScalar(this.extent));
    this.controls.target.copy(this.centre);
    this.draw();
  }

  clear() {
    if (this.draft) {
      this.scene.remove(this.draft);
      this.draft.dispose();
      this.draft = null;
    }
    clearTimeout(this.restTimer);
    this.restTimer = 0;
    if (this.mesh) {
      this.scene.remove(this.mesh);
      this.mesh.dispose();
      this.painter.dispose();
      this.mesh = null;
    }
    this.drawBoxes([]);
  }

  // Measure the centre and extent of the scene by the interquartile range of each axis, which ignores floaters.
  measureExtent() {
    const stride = Math.max(1, Math.floor(this.count / 5000));
    const axes = [[], [], []];
    for (let row = 0; row < this.count; row += stride) for (let axis = 0; axis < 3; axis += 1) axes[axis].push(this.floats[row * 8 + axis]);
    const quartiles = axes.map(values => values.sort((a, b) => a - b)).map(v => [v[Math.floor(v.length / 4)], v[Math.floor(v.length / 2)], v[Math.floor(3 * v.length / 4)]]);
    this.centre = new THREE.Vector3(...quartiles.map(end => end[1]));
    this.extent = Math.max(...quartiles.map(end => end[2] - end[0]), 1e-6);
    this.camera.near = this.extent / 500;
    this.camera.far = this.extent * 500;
    this.camera.updateProjectionMatrix();
  }

  // Hide splats, which are neither drawn nor picked then. hidden: a value for each row of the lift, or null.
  hide(hidden) {
    const { packedSplats } = this.mesh;
    const words = packedSplats.packedArray; // the first of four has the opacity in its highest byte
    for (let index = 0; index < this.count; index += 1) {
      const opacity = hidden?.[this.rowOf(index)] ? 0 : this.bytes[ROW_BYTES * index + 27];
      words[4 * index] = words[4 * index] & 0xffffff | opacity << 24;
    }
    packedSplats.needsUpdate = true;
    this.mesh.updateVersion();
    this.draw();
  }

  // The row of the lift of a drawn splat.
  rowOf(index) {
    return this.rows ? this.rows[index] : index;
  }

  // Paint questions and layers, see Painter.paint.
  paint(questions, options) {
    this.painter.paint(questions, options);
    this.mesh.updateVersion();
    this.draw();
  }

  // Estimate the up vector and the focus of the views. Cameras are seldom rolled, so up is the mean of their up vectors
  // without its part along their horizontal axes. The focus is the point nearest to their lines of sight.
  orient(views) {
    const poses = views.map(view => this.pose(view));
    const mean = poses.reduce((sum, pose) => sum.add(pose.up), new THREE.Vector3());
    this.up = mean.applyMatrix3(outerSum(poses.map(pose => pose.right), 1, 0.002 * poses.length).invert()).normalize();
    if (this.up.lengthSq() < 0.5) this.up.set(0, 0, 1);
    this.upright(this.up);
    // There is a floor: a drag goes no lower than the horizon, or than the lowest view.
    this.lowestAngle = this.controls.maxPolarAngle = Math.max(HORIZON, ...poses.map(({ forward }) => Math.PI - forward.angleTo(this.up)));
    const normal = outerSum(poses.map(pose => pose.forward), -1, poses.length); // sum of I - d d^T
    const rightSide = poses.reduce((sum, { position, forward }) => sum.add(position).addScaledVector(forward, -position.dot(forward)), new THREE.Vector3());
    const point = Math.abs(normal.determinant()) > 1e-6 * poses.length ** 3 ? rightSide.applyMatrix3(normal.invert()) : null;
    const inFront = point && poses.filter(pose => point.clone().sub(pose.position).dot(pose.forward) > 0).length > poses.length / 2;
    this.hasFocus = Boolean(inFront);
    this.focus = inFront ? point : this.centre.clone();
  }

  // Fit the field of view to the window: the full photo is visible.
  updateLens() {
    const { halfWidth, halfHeight } = this.lens || { halfWidth: 0.5, halfHeight: 0.5 };
    this.camera.fov = 2 * Math.atan(Math.max(halfHeight, halfWidth / this.camera.aspect)) * 180 / Math.PI;
    this.camera.updateProjectionMatrix();
  }

  goToView(view, quick) {
    const pose = this.pose(view);
    const depth = this.focus.clone().sub(pose.position).dot(pose.forward);
    const target = pose.position.clone().addScaledVector(pose.forward, depth > 0 ? depth : this.extent);
    this.lens = { halfWidth: view.width / 2 / view.fx, halfHeight: view.height / 2 / view.fy };
    this.updateLens();
    this.go(pose.position, target, quick);
  }

  // Fly to a box, from the direction of the camera or of a view that shows it. If the whole box is visible only from
  // farther away than the view, fly to the view itself.
  toBox({ low, high }, view = null) {
    const box = new THREE.Box3(this.toLocal(low), this.toLocal(high));
    const sphere = box.getBoundingSphere(new THREE.Sphere());
    const offset = view ? this.pose(view).position.sub(sphere.center) : this.camera.position.clone().sub(this.controls.target);
    const halfFov = this.camera.fov * Math.PI / 360;
    const distance = 1.9 * Math.max(sphere.radius, this.extent / 100) / Math.sin(Math.min(halfFov, Math.atan(Math.tan(halfFov) * this.camera.aspect)));
    if (view && distance > offset.length()) return this.goToView(view);
    this.go(sphere.center.clone().addScaledVector(offset.normalize(), distance), sphere.center);
  }

  toPoint(point) {
    const offset = this.camera.position.clone().sub(this.controls.target);
    const distance = 0.6 * this.camera.position.distanceTo(point);
    this.go(point.clone().addScaledVector(offset.normalize(), distance), point);
  }

  go(position, target, quick = prefersStill()) {
    this.takeLead();
    if (quick) {
      this.flight = null;
      this.camera.position.copy(position);
      this.controls.target.copy(target);
      this.onMove();
    } else {
      const start = { position: this.camera.position.clone(), target: this.controls.target.clone() };
      this.flight = { from: start, position: position.clone(), target: target.clone(), startTime: 0 };
    }
    this.draw();
  }

  stepFlight(now) {
    const flight = this.flight;
    if (!flight) return;
    flight.startTime ||= now;
    const share = Math.min(1, (now - flight.startTime) / FLIGHT_TIME);
    const eased = share * share * (3 - 2 * share);
    this.controls.target.lerpVectors(flight.from.target, flight.target, eased);
    this.camera.position.lerpVectors(flight.from.position, flight.position, eased);
    if (share === 1) {
      this.flight = null;
      this.onMove();
    }
  }

  // Turn the camera by angles in radians, for keys.
  turn(azimuth, polar) {
    this.isSteered = true;
    this.takeLead();
    const offset = this.camera.position.clone().sub(this.controls.target);
    const toYUp = new THREE.Quaternion().setFromUnitVectors(this.camera.up, new THREE.Vector3(0, 1, 0));
    const spherical = new THREE.Spherical().setFromVector3(offset.applyQuaternion(toYUp));
    spherical.theta += azimuth;
    spherical.phi = Math.min(spherical.phi + polar, this.lowestAngle);
    spherical.makeSafe();
    offset.setFromSpherical(spherical).applyQuaternion(toYUp.invert());
    this.camera.position.copy(this.controls.target).add(offset);
    this.onMove();
    this.draw();
  }

  zoom(factor) {
    this.isSteered = true;
    this.takeLead();
    this.camera.position.sub(this.controls.target).multiplyScalar(factor).add(this.controls.target);
    this.onMove();
    this.draw();
  }

  get place3d() {
    return [...this.camera.position.toArray(), ...this.controls.target.toArray()];
  }

  // Pick the splat nearest to where the ray of a canvas position hits the splats: {splat, point}, or null.
  pick(x, y) {
    if (!this.mesh) return null;
    this.mesh.context.numSplats.value = this.count; // also while fewer are drawn
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ray = new THREE.Raycaster();
    ray.setFromCamera(new THREE.Vector2(2 * x / width - 1, 1 - 2 * y / height), this.camera);
    const hit = ray.intersectObject(this.mesh)[0];
    if (!hit) return null;
    const { x: px, y: py, z: pz } = hit.point;
    const opacities = this.mesh.packedSplats.packedArray; // see hide
    let nearest = -1;
    let closest = Infinity;
    for (let index = 0; index < this.count; index += 1) {
      const dx = this.floats[8 * index] - px;
      const dy = this.floats[8 * index + 1] - py;
      const dz = this.floats[8 * index + 2] - pz;
      const distance = dx * dx + dy * dy + dz * dz;
      if (distance < closest && opacities[4 * index] >>> 24 >= MIN_PICK_OPACITY) {
        closest = distance;
        nearest = index;
      }
    }
    return nearest < 0 ? null : { splat: this.rowOf(nearest), point: hit.point };
  }

  // The centres of the splats of each value: medians, which ignore outliers. values: one for each row of the lift.
  centres(values, maxValue) {
    const rows = Array.from({ length: maxValue + 1 }, () => []);
    const stride = Math.max(1, Math.floor(this.count / SAMPLE_SIZE));
    for (let index = 0; index < this.count; index += stride) rows[values[this.rowOf(index)]].push(index);
    return rows.map(indices => (indices.length ? this.toWorld([0, 1, 2].map(axis => {
      const sorted = indices.map(index => this.floats[8 * index + axis]).sort((a, b) => a - b);
      return sorted[sorted.length >> 1];
    })) : null));
  }

  // This camera as the service takes it, for a picture of at most maxWidth pixels.
  cameraRequest(maxWidth) {
    const { clientWidth, clientHeight } = this.canvas.parentElement;
    const width = Math.min(clientWidth, maxWidth);
    const height = Math.round(clientHeight * width / clientWidth);
    this.camera.lookAt(this.controls.target); // as the controls do before the next frame
    this.camera.updateMatrixWorld();
    const m = this.camera.matrixWorldInverse.elements; // columns, OpenGL axes
    const viewmat = [0, 1, 2, 3].map(row => [0, 1, 2, 3].map(column => (row === 1 || row === 2 ? -1 : 1) * m[4 * column + row]));
    for (const row of viewmat.slice(0, 3)) row[3] -= dotRow(row, this.origin);
    return { width, height, fx: height / 2 / Math.tan(this.camera.fov * Math.PI / 360), viewmat };
  }

  // Draw boxes of objects: [{low, high, colour, strong}].
  drawBoxes(boxes) {
    for (const line of this.boxes.children) line.geometry.dispose();
    this.boxes.clear();
    for (const { low, high, colour, strong } of boxes) {
      const box = new THREE.Box3(this.toLocal(low), this.toLocal(high));
      const line = new THREE.Box3Helper(box, new THREE.Color(colour));
      Object.assign(line.material, { depthTest: false, transparent: true, opacity: strong ? 1 : 0.45 });
      line.renderOrder = 10;
      this.boxes.add(line);
    }
    this.draw();
  }
}

const pixelRatio = () => Math.min(devicePixelRatio, 1.5);

// Every step-th of the rows, in steps of the golden ratio, so that the first n rows are spread evenly for every n.
function spreadRows(count, step) {
  const greatestDivisor = (a, b) => (b ? greatestDivisor(b, a % b) : a);
  let stride = Math.round(count * (Math.sqrt(5) - 1) / 2);
  while (greatestDivisor(count, stride) > 1) stride += 1;
  const rows = new Uint32Array(count);
  for (let index = 0; index < count; index += 1) rows[index] = index * stride % count * step;
  return rows;
}

// Position and axes of a camera from its world-to-camera matrix, OpenCV axes: x right, y down, z forward.
function poseOf(m) {
  const position = new THREE.Vector3(...[0, 1, 2].map(axis => -(m[0][axis] * m[0][3] + m[1][axis] * m[1][3] + m[2][axis] * m[2][3])));
  return { position, right: new THREE.Vector3(m[0][0], m[0][1], m[0][2]), forward: new THREE.Vector3(m[2][0], m[2][1], m[2][2]), up: new THREE.Vector3(-m[1][0], -m[1][1], -m[1][2]) };
}

// The dot product of the first three numbers of a row and a point.
function dotRow(row, point) {
  return row[0] * point[0] + row[1] * point[1] + row[2] * point[2];
}

// The matrix sign * sum of v v^T + ridge * I of world vectors.
function outerSum(vectors, sign, ridge) {
  const { elements } = new THREE.Matrix3().multiplyScalar(ridge);
  for (const vector of vectors) {
    const v = vector.toArray();
    for (let index = 0; index < 9; index += 1) elements[index] += sign * v[Math.floor(index / 3)] * v[index % 3];
  }
  return new THREE.Matrix3().fromArray(elements);
}
