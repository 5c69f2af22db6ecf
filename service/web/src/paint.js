// Scores to colours: which splats a question lights up, a histogram, and a map of heat.
export const COLOURS = ["#ffb000", "#38b6ff", "#ff5fa2", "#54d67f", "#b48cff", "#ff7a45"]; // of questions, in turn
export const BINS = 96;
const UNKNOWN = -0.999999; // splats without a feature score -1
const TINT = 66; // of 127: how much of what was found is in its question's colour
const SHADE = 104; // of 127: how much of the rest is in shade
const HEAT = 118;
const STOPS = [[34, 20, 66], [64, 48, 132], [42, 105, 140], [36, 152, 122], [120, 194, 72], [251, 233, 96]];

export const rgb = colour => [1, 3, 5].map(place => parseInt(colour.slice(place, place + 2), 16));

export const heatMap = Uint8Array.from({ length: 256 * 3 }, (_, place) => {
  const at = Math.floor(place / 3) / 255 * (STOPS.length - 1);
  const low = Math.min(Math.floor(at), STOPS.length - 2);
  return Math.round(STOPS[low][place % 3] + (at - low) * (STOPS[low + 1][place % 3] - STOPS[low][place % 3]));
});

// Scores counted between the least and the greatest of the splats that have one.
export function histogram(scores, low, high) {
  const bins = new Uint32Array(BINS);
  const scale = high > low ? BINS / (high - low) : 0;
  for (const score of scores) {
    if (score > UNKNOWN) bins[Math.max(0, Math.min(BINS - 1, Math.floor((score - low) * scale)))] += 1;
  }
  return bins;
}

export function countFrom(scores, cut) {
  let found = 0;
  for (const score of scores) if (score >= cut && score > UNKNOWN) found += 1;
  return found;
}

const packed = (r, g, b, a) => (r | g << 8 | b << 16 | a << 24) >>> 0; // as bytes lie in memory

// The shade of each drawn splat of a .splat file's bytes: what was not found is a dark grey of its own brightness.
export function shades(own) {
  const made = new Uint32Array(own.length / 32);
  for (let place = 0, from = 24; place < made.length; place += 1, from += 32) {
    const grey = (0.3 * own[from] + 0.59 * own[from + 1] + 0.11 * own[from + 2]) * 0.42 + 4;
    made[place] = packed(grey, grey, grey, SHADE);
  }
  return made;
}

// Paint every drawn splat. paints: u32 [drawn], r g b and the byte of `painter`; rows: of the lift, as they are drawn,
// or null. questions: [{scores, cut, high, low, rgb}] that light up; the one that a splat passes by most has it.
// shade: of `shades`; heat: a question whose scores are shown instead, or null; layer: {colours: u8 [P, 3], cover:
// 0..1} beneath, or null.
export function paint(paints, rows, shade, questions, { heat = null, layer = null } = {}) {
  const count = paints.length;
  const cover = layer ? Math.round(127 * layer.cover * (questions.length ? 0.6 : 1)) : 0;
  if (layer) {
    const { colours } = layer;
    for (let place = 0; place < count; place += 1) {
      const from = 3 * (rows ? rows[place] : place);
      paints[place] = packed(colours[from], colours[from + 1], colours[from + 2], cover);
    }
  } else if (questions.length) {
    paints.set(shade);
  } else {
    paints.fill(0);
  }
  const most = questions.length > 1 ? new Float32Array(count).fill(-1) : null;
  for (const { scores, cut, high, rgb: [r, g, b] } of questions) {
    const mine = packed(r, g, b, 128 + TINT);
    const least = Math.max(cut, UNKNOWN);
    for (let place = 0; place < count; place += 1) {
      const score = scores[rows ? rows[place] : place];
      if (score < least) continue;
      if (most) {
        const over = (score - cut) / (high - cut || 1);
        if (over <= most[place]) continue;
        most[place] = over;
      }
      paints[place] = mine;
    }
  }
  if (!heat) return;
  const { scores, low, high } = heat;
  const warm = high > low ? 255 / (high - low) : 0;
  for (let place = 0; place < count; place += 1) {
    const level = 3 * Math.max(0, Math.min(255, Math.round((scores[rows ? rows[place] : place] - low) * warm)));
    const found = paints[place] >>> 31 ? 128 : 0;
    paints[place] = packed(heatMap[level], heatMap[level + 1], heatMap[level + 2], HEAT + found);
  }
}

// The bars of a histogram with what is cut off pale, and a mark where the automatic cut is.
export function drawHistogram(canvas, { bins, low, high, cut, auto, colour }) {
  const ratio = devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  canvas.width = Math.round(width * ratio);
  canvas.height = Math.round(height * ratio);
  const context = canvas.getContext("2d");
  context.scale(ratio, ratio);
  const most = Math.sqrt(Math.max(...bins, 1)); // roots: a hill of a small thing is seen beside a mountain
  const wide = width / bins.length;
  const quiet = getComputedStyle(canvas).getPropertyValue("--quiet");
  bins.forEach((bin, place) => {
    const tall = bin ? Math.max(1.5, Math.sqrt(bin) / most * (height - 4)) : 0;
    context.fillStyle = low + (place + 0.5) / bins.length * (high - low) >= cut ? colour : quiet;
    context.globalAlpha = low + (place + 0.5) / bins.length * (high - low) >= cut ? 1 : 0.4;
    context.fillRect(place * wide + 0.5, height - tall, Math.max(1, wide - 1), tall);
  });
  if (auto === null || high <= low) return;
  const x = (auto - low) / (high - low) * width;
  context.globalAlpha = 0.9;
  context.fillStyle = quiet;
  for (let y = 0; y < height; y += 6) context.fillRect(x - 0.5, y, 1.5, 3);
}
