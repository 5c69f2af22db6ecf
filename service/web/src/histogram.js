// How many splats have which score, as numbers and as bars.
import { UNKNOWN, atLeast } from "./painter.js";

const BINS = 96;

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
  const least = atLeast(cut);
  let found = 0;
  for (const score of scores) if (score >= least && score > UNKNOWN) found += 1;
  return found;
}

// Scores that pass a cut where splats are selected, and nowhere else: the automatic answer is more than its threshold.
export function passing(scores, selected, cut) {
  const least = atLeast(cut);
  return scores.map((score, place) => selected[place] ? Math.max(score, least) : score < least ? score : UNKNOWN);
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
