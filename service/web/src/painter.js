// Splats in the colours of what is asked: scores lie in a texture, a row a splat, and the shader compares them with the
// cut. A slider writes one number, whatever the scene's size.
import * as THREE from "three";
import { dyno } from "@sparkjsdev/spark";

export const COLOURS = ["#ffb000", "#38b6ff", "#ff5fa2", "#54d67f", "#b48cff", "#ff7a45"]; // of questions, in turn
export const UNKNOWN = -0.999999; // splats without a feature score -1
const STOPS = [[34, 20, 66], [64, 48, 132], [42, 105, 140], [36, 152, 122], [120, 194, 72], [251, 233, 96]];
const WIDE = 2048; // texels of a row: every GPU has so many
const TINT = 0.52; // how much of what was found is in its question's colour
const SHADE = 0.82; // how much of the rest is in a dark grey of its own brightness
const HEAT = 0.93;
const UNDER = 0.6; // of a layer, when something is asked over it

export const rgb = colour => [1, 3, 5].map(place => parseInt(colour.slice(place, place + 2), 16));

// The least 32-bit number that is not below a 64-bit one: scores pass it as they pass that.
const least = new Float32Array(1);
const bits = new Int32Array(least.buffer);
export function atLeast(cut) {
  least[0] = Math.max(-3e38, Math.min(3e38, cut));
  if (least[0] < cut) bits[0] += least[0] < 0 ? -1 : 1;
  return least[0];
}

export class Painter {
  // count: of drawn splats; rows: of the lift, as they are drawn, or null.
  constructor(count, rows) {
    Object.assign(this, { count, rows, high: Math.ceil(count / WIDE), kept: [], shown: null });
    const uniform = (type, value, length) => new dyno.DynoUniform({ key: "value", type, count: length, value });
    this.scores = uniform("sampler2DArray", texture(new Float32Array(1), 1, 1, 1));
    this.layer = uniform("sampler2DArray", texture(new Uint8Array(4), 1, 1, 1));
    this.asked = uniform("vec4", COLOURS.map(() => new THREE.Vector4()), COLOURS.length); // r g b and the cut
    this.most = uniform("float", COLOURS.map(() => 1), COLOURS.length); // the highest score
    this.state = uniform("vec4", new THREE.Vector4(0, 0, 0, -1)); // questions, cover of the layer, hide the rest, whose heat
    this.warm = uniform("vec2", new THREE.Vector2(0, 1)); // scores of the ends of the heat
    this.size = uniform("float", 1); // times a splat's own
    this.modifier = dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => this.block(gsplat));
  }

  block(gsplat) {
    const { scores, layer, asked, most, state, warm, size } = this;
    const made = new dyno.Dyno({
      inTypes: { gsplat: dyno.Gsplat, index: "int", scores: "sampler2DArray", layer: "sampler2DArray", asked: "vec4", most: "float", state: "vec4", warm: "vec2", size: "float" },
      outTypes: { gsplat: dyno.Gsplat },
      inputs: { gsplat, index: dyno.splitGsplat(gsplat).outputs.index, scores, layer, asked, most, state, warm, size },
      globals: () => [dyno.defineGsplat, HEAT_MAP],
      statements: ({ inputs: at, outputs: { gsplat: out } }) => `
        ${out} = ${at.gsplat};
        ${out}.scales *= ${at.size};
        {
          ivec2 cell = ivec2(${at.index} % ${WIDE}, ${at.index} / ${WIDE});
          vec3 own = ${out}.rgba.rgb;
          vec3 shown = own;
          bool found = false;
          if (${at.state}.y > 0.0) {
            shown = mix(own, texelFetch(${at.layer}, ivec3(cell, 0), 0).rgb, ${at.state}.y);
          } else if (${at.state}.x > 0.5) {
            shown = mix(own, vec3(dot(own, vec3(0.3, 0.59, 0.11)) * 0.42 + 0.016), ${SHADE.toFixed(3)});
          }
          float best = -1.0;
          for (int q = 0; q < ${COLOURS.length}; q++) {
            if (float(q) + 0.5 > ${at.state}.x) break;
            float score = texelFetch(${at.scores}, ivec3(cell, q), 0).r;
            float cut = ${at.asked}[q].w;
            float over = (score - cut) / max(${at.most}[q] - cut, 1e-9);
            if (score < cut || score <= ${UNKNOWN.toFixed(6)} || over <= best) continue;
            best = over;
            found = true;
            shown = mix(own, ${at.asked}[q].rgb, ${TINT.toFixed(3)});
          }
          if (${at.state}.w > -0.5) {
            float score = texelFetch(${at.scores}, ivec3(cell, int(${at.state}.w + 0.5)), 0).r;
            shown = mix(own, heatOf((score - ${at.warm}.x) / max(${at.warm}.y - ${at.warm}.x, 1e-9)), ${HEAT.toFixed(3)});
          }
          ${out}.rgba.rgb = shown;
          if (!found) ${out}.rgba.a *= 1.0 - ${at.state}.z;
        }`.split("\n"),
    });
    return { gsplat: made.outputs.gsplat };
  }

  // questions: [{scores, cut, high, rgb}] that light up; the one that a splat passes by most has it. heat: one of
  // them, whose scores are shown instead, or null. layer: {colours: u8 [P, 3], cover: 0..1} beneath, or null.
  paint(questions, { heat = null, layer = null, hide = false } = {}) {
    const heated = heat ? questions.findIndex(({ scores }) => scores === heat.scores) : -1;
    const lying = heat && heated < 0 ? [...questions, heat] : questions; // what is not clear has its heat all the same
    this.lay(lying.map(({ scores }) => scores));
    questions.forEach(({ cut, high, rgb: [r, g, b] }, place) => {
      this.asked.value[place].set(r / 255, g / 255, b / 255, atLeast(cut));
      this.most.value[place] = high;
    });
    if (layer && this.shown !== layer.colours) this.layColours(layer.colours);
    const cover = layer ? layer.cover * (questions.length ? UNDER : 1) : 0;
    this.state.value.set(questions.length, cover, hide && questions.length ? 1 : 0, heat ? (heated < 0 ? questions.length : heated) : -1);
    if (heat) this.warm.value.set(heat.low, heat.high);
  }

  widen(size) {
    this.size.value = size;
  }

  // Scores go to the GPU once, when they are new.
  lay(all) {
    const { image } = this.scores.value;
    const size = WIDE * this.high;
    if (all.length && (image.depth < all.length || image.width !== WIDE)) {
      this.scores.value.dispose();
      this.scores.value = texture(new Float32Array(size * all.length), WIDE, this.high, all.length);
      this.kept = [];
    }
    all.forEach((scores, place) => {
      if (this.kept[place] === scores) return;
      this.kept[place] = scores;
      const { data } = this.scores.value.image;
      if (this.rows) for (let drawn = 0; drawn < this.count; drawn += 1) data[size * place + drawn] = scores[this.rows[drawn]]; else data.set(scores, size * place);
      this.scores.value.addLayerUpdate(place);
      this.scores.value.needsUpdate = true;
    });
  }

  layColours(colours) {
    this.shown = colours;
    const data = new Uint8Array(4 * WIDE * this.high);
    for (let place = 0; place < this.count; place += 1) {
      const from = 3 * (this.rows ? this.rows[place] : place);
      data[4 * place] = colours[from];
      data[4 * place + 1] = colours[from + 1];
      data[4 * place + 2] = colours[from + 2];
    }
    this.layer.value.dispose();
    this.layer.value = texture(data, WIDE, this.high, 1);
  }

  dispose() {
    this.scores.value.dispose();
    this.layer.value.dispose();
  }
}

const HEAT_MAP = `
vec3 heatOf(float share) {
  vec3 stops[${STOPS.length}] = vec3[](${STOPS.map(stop => `vec3(${stop.map(value => (value / 255).toFixed(4)).join(", ")})`).join(", ")});
  float at = clamp(share, 0.0, 1.0) * ${(STOPS.length - 1).toFixed(1)};
  int low = min(int(at), ${STOPS.length - 2});
  return mix(stops[low], stops[low + 1], at - float(low));
}`;

function texture(data, width, high, depth) {
  const made = new THREE.DataArrayTexture(data, width, high, depth);
  made.format = data instanceof Float32Array ? THREE.RedFormat : THREE.RGBAFormat;
  made.type = data instanceof Float32Array ? THREE.FloatType : THREE.UnsignedByteType;
  made.needsUpdate = true;
  return made;
}
