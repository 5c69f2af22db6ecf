// Colours of splats by their scores, and the histogram of the scores. Scores are in a texture, a texel a splat, and the shader compares them with the
// threshold, so a slider writes one number whatever the size of the scene.
import * as THREE from "three";
import { dyno } from "@sparkjsdev/spark";

export const COLOURS = ["#ffb000", "#38b6ff", "#ff5fa2", "#54d67f", "#b48cff", "#ff7a45"]; // of questions, by their order
const UNKNOWN = -0.999999; // splats without a feature score -1
const STOPS = [[34, 20, 66], [64, 48, 132], [42, 105, 140], [36, 152, 122], [120, 194, 72], [251, 233, 96]];
const TEXTURE_WIDTH = 2048; // texels of a row, within the limit of every GPU
const TINT = 0.52; // share of the question's colour in a selected splat
const SHADE = 0.82; // share of dark grey in the other splats
const HEAT = 0.93; // share of the heat colour
const LAYER_UNDER_QUERY = 0.6; // opacity of a layer below a question
const BINS = 96; // of the histogram

export const rgb = colour => [1, 3, 5].map(index => parseInt(colour.slice(index, index + 2), 16));

// The smallest float32 that is not below a float64: float32 scores pass both alike.
const least = new Float32Array(1);
const bits = new Int32Array(least.buffer);
function atLeast(cut) {
  least[0] = Math.max(-3e38, Math.min(3e38, cut));
  if (least[0] < cut) bits[0] += least[0] < 0 ? -1 : 1;
  return least[0];
}

export class Painter {
  // count: number of drawn splats. rows: row of the lift for each drawn splat, or null if they are the same.
  constructor(count, rows) {
    Object.assign(this, { count, rows, textureRows: Math.ceil(count / TEXTURE_WIDTH), uploadedScores: [], layerColours: null });
    const uniform = (type, value, length) => new dyno.DynoUniform({ key: "value", type, count: length, value });
    this.scores = uniform("sampler2DArray", texture(new Float32Array(1), 1, 1, 1));
    this.layer = uniform("sampler2DArray", texture(new Uint8Array(4), 1, 1, 1));
    this.queryColours = uniform("vec4", COLOURS.map(() => new THREE.Vector4()), COLOURS.length); // r, g, b, threshold
    this.maxScores = uniform("float", COLOURS.map(() => 1), COLOURS.length); // the highest score of each question
    this.drawState = uniform("vec4", new THREE.Vector4(0, 0, 0, -1)); // number of questions, opacity of the layer, 1 to hide other splats, question shown as heat or -1
    this.heatRange = uniform("vec2", new THREE.Vector2(0, 1)); // scores of the first and last heat colour
    this.splatScale = uniform("float", 1); // factor of the size of a splat
    this.modifier = dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => this.shader(gsplat));
  }

  shader(gsplat) {
    const { scores, layer, queryColours, maxScores, drawState, heatRange, splatScale } = this;
    const node = new dyno.Dyno({
      inTypes: { gsplat: dyno.Gsplat, index: "int", scores: "sampler2DArray", layer: "sampler2DArray", queryColours: "vec4", maxScores: "float", drawState: "vec4", heatRange: "vec2", splatScale: "float" },
      outTypes: { gsplat: dyno.Gsplat },
      inputs: { gsplat, index: dyno.splitGsplat(gsplat).outputs.index, scores, layer, queryColours, maxScores, drawState, heatRange, splatScale },
      globals: () => [dyno.defineGsplat, HEAT_MAP],
      statements: ({ inputs, outputs: { gsplat: out } }) => `
        ${out} = ${inputs.gsplat};
        ${out}.scales *= ${inputs.splatScale};
        {
          ivec2 cell = ivec2(${inputs.index} % ${TEXTURE_WIDTH}, ${inputs.index} / ${TEXTURE_WIDTH});
          vec3 base = ${out}.rgba.rgb;
          vec3 colour = base;
          bool selected = false;
          if (${inputs.drawState}.y > 0.0) {
            colour = mix(base, texelFetch(${inputs.layer}, ivec3(cell, 0), 0).rgb, ${inputs.drawState}.y);
          } else if (${inputs.drawState}.x > 0.5) {
            colour = mix(base, vec3(dot(base, vec3(0.3, 0.59, 0.11)) * 0.42 + 0.016), ${SHADE.toFixed(3)});
          }
          float best = -1.0;
          for (int q = 0; q < ${COLOURS.length}; q++) {
            if (float(q) + 0.5 > ${inputs.drawState}.x) break;
            float score = texelFetch(${inputs.scores}, ivec3(cell, q), 0).r;
            float cut = ${inputs.queryColours}[q].w;
            float over = (score - cut) / max(${inputs.maxScores}[q] - cut, 1e-9);
            if (score < cut || score <= ${UNKNOWN.toFixed(6)} || over <= best) continue;
            best = over;
            selected = true;
            colour = mix(base, ${inputs.queryColours}[q].rgb, ${TINT.toFixed(3)});
          }
          if (${inputs.drawState}.w > -0.5) {
            float score = texelFetch(${inputs.scores}, ivec3(cell, int(${inputs.drawState}.w + 0.5)), 0).r;
            colour = mix(base, heatColour((score - ${inputs.heatRange}.x) / max(${inputs.heatRange}.y - ${inputs.heatRange}.x, 1e-9)), ${HEAT.toFixed(3)});
          }
          ${out}.rgba.rgb = colour;
          if (!selected) ${out}.rgba.a *= 1.0 - ${inputs.drawState}.z;
        }`.split("\n"),
    });
    return { gsplat: node.outputs.gsplat };
  }

  // questions: [{scores, cut, high, rgb}]; a splat has the colour of the question whose threshold it exceeds most. heat:
  // {scores, low, high} to show as heat instead, or null. layer: {colours: u8 [P, 3], cover: 0..1} below, or null.
  paint(questions, { heat = null, layer = null, hide = false } = {}) {
    const heatIndex = heat ? questions.findIndex(({ scores }) => scores === heat.scores) : -1;
    const textures = heat && heatIndex < 0 ? [...questions, heat] : questions; // heat is shown also without a selection
    this.uploadScores(textures.map(({ scores }) => scores));
    questions.forEach(({ cut, high: textureRows, rgb: [r, g, b] }, index) => {
      this.queryColours.value[index].set(r / 255, g / 255, b / 255, atLeast(cut));
      this.maxScores.value[index] = textureRows;
    });
    if (layer && this.layerColours !== layer.colours) this.uploadColours(layer.colours);
    const cover = layer ? layer.cover * (questions.length ? LAYER_UNDER_QUERY : 1) : 0;
    this.drawState.value.set(questions.length, cover, hide && questions.length ? 1 : 0, heat ? (heatIndex < 0 ? questions.length : heatIndex) : -1);
    if (heat) this.heatRange.value.set(heat.low, heat.high);
  }

  setScale(size) {
    this.splatScale.value = size;
  }

  // Copy new scores to the GPU.
  uploadScores(scoreLists) {
    const { image } = this.scores.value;
    const size = TEXTURE_WIDTH * this.textureRows;
    if (scoreLists.length && (image.depth < scoreLists.length || image.width !== TEXTURE_WIDTH)) {
      this.scores.value.dispose();
      this.scores.value = texture(new Float32Array(size * scoreLists.length), TEXTURE_WIDTH, this.textureRows, scoreLists.length);
      this.uploadedScores = [];
    }
    scoreLists.forEach((scores, index) => {
      if (this.uploadedScores[index] === scores) return;
      this.uploadedScores[index] = scores;
      const { data } = this.scores.value.image;
      if (this.rows) for (let position = 0; position < this.count; position += 1) data[size * index + position] = scores[this.rows[position]]; else data.set(scores, size * index);
      this.scores.value.addLayerUpdate(index);
      this.scores.value.needsUpdate = true;
    });
  }

  uploadColours(colours) {
    this.layerColours = colours;
    const data = new Uint8Array(4 * TEXTURE_WIDTH * this.textureRows);
    for (let index = 0; index < this.count; index += 1) {
      const source = 3 * (this.rows ? this.rows[index] : index);
      data[4 * index] = colours[source];
      data[4 * index + 1] = colours[source + 1];
      data[4 * index + 2] = colours[source + 2];
    }
    this.layer.value.dispose();
    this.layer.value = texture(data, TEXTURE_WIDTH, this.textureRows, 1);
  }

  dispose() {
    this.scores.value.dispose();
    this.layer.value.dispose();
  }
}

const HEAT_MAP = `
vec3 heatColour(float share) {
  vec3 stops[${STOPS.length}] = vec3[](${STOPS.map(stop => `vec3(${stop.map(value => (value / 255).toFixed(4)).join(", ")})`).join(", ")});
  float at = clamp(share, 0.0, 1.0) * ${(STOPS.length - 1).toFixed(1)};
  int low = min(int(at), ${STOPS.length - 2});
  return mix(stops[low], stops[low + 1], at - float(low));
}`;

function texture(data, width, textureRows, depth) {
  const result = new THREE.DataArrayTexture(data, width, textureRows, depth);
  result.format = data instanceof Float32Array ? THREE.RedFormat : THREE.RGBAFormat;
  result.type = data instanceof Float32Array ? THREE.FloatType : THREE.UnsignedByteType;
  result.needsUpdate = true;
  return result;
}

// Count the scores from low to high in equal bins; splats without a feature are left out.
export function histogram(scores, low, high) {
  const bins = new Uint32Array(BINS);
  const scale = high > low ? BINS / (high - low) : 0;
  for (const score of scores) {
    if (score > UNKNOWN) bins[Math.max(0, Math.min(BINS - 1, Math.floor((score - low) * scale)))] += 1;
  }
  return bins;
}

export function countFrom(scores, cut) {
  const minimum = atLeast(cut);
  let total = 0;
  for (const score of scores) if (score >= minimum && score > UNKNOWN) total += 1;
  return total;
}

// Scores that pass the cut where splats are selected, and nowhere else: an automatic answer is more than a threshold.
export function passing(scores, selected, cut) {
  const minimum = atLeast(cut);
  return scores.map((score, index) => selected[index] ? Math.max(score, minimum) : score < minimum ? score : UNKNOWN);
}

// Draw a histogram: bars below the cut are pale, a dashed line marks the automatic cut.
export function drawHistogram(canvas, { bins, low, high, cut, auto, colour }) {
  const ratio = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const tallest = Math.sqrt(Math.max(...bins, 1)); // square roots keep small bins visible
  const barWidth = width / bins.length;
  const paleColour = getComputedStyle(canvas).getPropertyValue("--quiet");
  bins.forEach((bin, index) => {
    const barHeight = bin ? Math.max(1.5, Math.sqrt(bin) / tallest * (height - 4)) : 0;
    context.fillStyle = low + (index + 0.5) / bins.length * (high - low) >= cut ? colour : paleColour;
    context.globalAlpha = low + (index + 0.5) / bins.length * (high - low) >= cut ? 1 : 0.4;
    context.fillRect(index * barWidth + 0.5, height - barHeight, Math.max(1, barWidth - 1), barHeight);
  });
  if (auto === null || high <= low) return;
  const x = (auto - low) / (high - low) * width;
  context.globalAlpha = 0.9;
  context.fillStyle = paleColour;
  for (let y = 0; y < height; y += 6) context.fillRect(x - 0.5, y, 1.5, 3);
}
