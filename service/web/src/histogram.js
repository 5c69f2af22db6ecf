// The histogram of scores, as numbers and as bars.
import { UNKNOWN, atLeast } from "./painter.js";

const BINS = 96;

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
