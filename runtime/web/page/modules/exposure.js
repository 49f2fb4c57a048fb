/**
 * Exposure and white balance of two views: a gain and an offset for each view and channel, from matched points, by
 * iteratively reweighted least squares; nothing where the views differ little. The rule and its constants are those of
 * the command.
 */

import { solve } from "./linear.js";
import { blur } from "./scale_space.js";

const BLUR = 1 / 128; // of the longer side
const [DARKEST, BRIGHTEST] = [0.04, 0.95];
const MAX_POINTS = 400;
const CELLS = 8; // of an image, along each side
const MIN_CELLS = 6;
const [GAIN_SIGMA, BIAS_SIGMA] = [0.3, 0.03];
const MAX_GAIN = 2.5;
const ITERATIONS = 12;
const MIN_NOISE = 0.002;
const TUKEY = 4.685;
const TO_SIGMA = 1.4826;
const EPSILON = 1e-9;
const OUTLIER = 4;
const MIN_DIFFERENCE = 0.05;
const MIN_SIGNIFICANCE = 2;
const CHANNELS = [0, 1, 2];

/** @typedef {{ first: number[], second: number[], cell: number, black: boolean }} Sample colours of a matched point */
/** @typedef {{ logGains: number[][], biases: number[][] }} Fit of both views, by channel */

/**
 * Bring two views to a common exposure. Returns the difference, and whether it was compensated.
 * @param {import("./views.js").View[]} views their images are changed @param {number[][][]} matches
 */
export function compensateExposure(views, matches, height, width) {
  const samples = sample(views, matches, height, width);
  if (samples === null) return { difference: null, compensated: false };
  const fit = fitExposure(samples);
  const gains = fit.logGains.map((row) => row.map((log) => Math.exp(clip(log, -Math.log(MAX_GAIN), Math.log(MAX_GAIN)))));
  const ratios = CHANNELS.map((c) => {
    const mean = samples.reduce((sum, { first, second }) => sum + first[c] + second[c], 0) / samples.length / 2;
    const corrected = [0, 1].map((view) => gains[view][c] * (mean + fit.biases[view][c]));
    return Math.max(...corrected) / Math.max(Math.min(...corrected), DARKEST);
  });
  const difference = Math.max(...ratios) - 1;
  const compensated = difference >= MIN_DIFFERENCE && significance(samples) >= MIN_SIGNIFICANCE;
  if (compensated) views.forEach((view, index) => correct(view.image, gains[index], fit.biases[index]));
  return { difference, compensated };
}

function correct(image, gains, biases) {
  const plane = image.length / 3;
  for (const c of CHANNELS) {
    const [gain, offset] = [Math.fround(gains[c]), Math.fround(gains[c] * biases[c])];
    for (let i = c * plane; i < (c + 1) * plane; i++) image[i] = clip(Math.fround(gain * image[i]) + offset, 0, 1);
  }
}

// ---- colours of matched points

function sample(views, matches, height, width) {
  const blurred = views.map(({ image }) =>
    CHANNELS.map((c) => {
      const data = image.slice(c * height * width, (c + 1) * height * width);
      return blur({ data, width, height }, BLUR * Math.max(height, width));
    }),
  );
  const found = [];
  for (const points of matches) {
    const [first, second] = points.map((point, view) => {
      const [fx, fy, cx, cy] = views[view].intrinsics;
      return { x: point[0] * fx + cx, y: point[1] * fy + cy };
    });
    const [a, b] = [colours(blurred[0], first), colours(blurred[1], second)];
    if (CHANNELS.every((c) => Math.min(a[c], b[c]) > DARKEST && Math.max(a[c], b[c]) < BRIGHTEST)) {
      const [column, row] = [first.x, first.y].map((value) => Math.trunc(clip(value * CELLS, 0, CELLS - 1)));
      found.push({ first: a, second: b, cell: column * CELLS + row, black: (row + column) % 2 === 0 });
    }
  }
  if (new Set(found.map(({ cell }) => cell)).size < MIN_CELLS) return null;
  const step = Math.ceil(found.length / MAX_POINTS);
  return found.filter((_, index) => index % step === 0);
}

/** Bilinear samples of the planes at a position in [0, 1]. */
function colours(planes, { x, y }) {
  const { width, height } = planes[0];
  const [u, v] = [Math.fround(x * width - 0.5), Math.fround(y * height - 0.5)];
  const [x0, y0] = [Math.floor(u), Math.floor(v)];
  const at = (data, i, j) => data[clip(j, 0, height - 1) * width + clip(i, 0, width - 1)];
  return planes.map(({ data }) => {
    const upper = at(data, x0, y0) * (1 - u + x0) + at(data, x0 + 1, y0) * (u - x0);
    const lower = at(data, x0, y0 + 1) * (1 - u + x0) + at(data, x0 + 1, y0 + 1) * (u - x0);
    return upper * (1 - v + y0) + lower * (v - y0);
  });
}

/** Weights of the points; those of the points in one cell add up to 1. @param {Sample[]} samples */
function votes(samples) {
  const counts = new Map();
  for (const { cell } of samples) counts.set(cell, (counts.get(cell) ?? 0) + 1);
  return samples.map(({ cell }) => 1 / counts.get(cell));
}

// ---- least squares

/** Gauss-Newton with Tukey's weights, at the scale of the residuals. @param {Sample[]} samples @returns {Fit} */
function fitExposure(samples) {
  const weights = votes(samples);
  let found = CHANNELS.map(() => [0, 0, 0, 0]); // of each channel: two log gains, two biases
  for (let step = 0; step < ITERATIONS; step++) {
    const rows = samples.map((point) => CHANNELS.map((c) => residual(point.first[c], point.second[c], found[c])));
    const sizes = rows.map((row) => Math.sqrt(row.reduce((sum, { value }) => sum + value ** 2, 0) / 3));
    const noise = Math.max(TO_SIGMA * weightedMedian(sizes, weights), MIN_NOISE);
    const trust = sizes.map((size, i) => weights[i] * Math.max(1 - (size / (TUKEY * noise)) ** 2, 0) ** 2);
    const prior = [GAIN_SIGMA, GAIN_SIGMA, BIAS_SIGMA, BIAS_SIGMA].map((sigma) => noise ** 2 / sigma ** 2);
    found = found.map((values, c) => {
      const equations = values.map((value, k) => {
        const own = [0, 0, 0, 0, prior[k] * value];
        own[k] = prior[k];
        return own;
      });
      rows.forEach((row, i) => {
        const { value, slopes } = row[c];
        for (let k = 0; k < 4; k++) {
          for (let l = 0; l < 4; l++) equations[k][l] += trust[i] * slopes[k] * slopes[l];
          equations[k][4] += trust[i] * slopes[k] * value;
        }
      });
      const shift = solve(equations);
      return values.map((value, k) => value - shift[k]);
    });
  }
  return {
    logGains: [0, 1].map((view) => CHANNELS.map((c) => found[c][view])),
    biases: [0, 1].map((view) => CHANNELS.map((c) => found[c][2 + view])),
  };
}

/** Difference of corrected values over the root mean square of both gains, and its derivatives. */
function residual(first, second, [logA, logB, biasA, biasB]) {
  const [a, b] = [Math.exp(logA), Math.exp(logB)];
  const [left, right] = [a * (first + biasA), b * (second + biasB)];
  const square = (a * a + b * b) / 2;
  const scale = Math.sqrt(square);
  const value = (left - right) / scale;
  const byA = left / scale - (value * a * a) / (2 * square);
  const byB = -right / scale - (value * b * b) / (2 * square);
  return { value, slopes: [byA, byB, a / scale, -b / scale] };
}

/** By how many standard errors a fit reduces the differences at points that it has not seen: a chessboard's halves. */
function significance(samples) {
  const halves = [true, false].map((black) => samples.filter((point) => point.black === black));
  if (halves.some((half) => half.length === 0)) return 0;
  const none = { logGains: [[0, 0, 0], [0, 0, 0]], biases: [[0, 0, 0], [0, 0, 0]] };
  const fits = new Map([[true, fitExposure(halves[1])], [false, fitExposure(halves[0])]]);
  const before = samples.map((point) => size(point, none));
  const after = samples.map((point) => size(point, fits.get(point.black) ?? none));
  const weights = votes(samples);
  const limit = OUTLIER * weightedMedian(before, weights);
  const byCell = new Map();
  samples.forEach(({ cell }, i) => {
    const reduction = Math.min(before[i], limit) - Math.min(after[i], limit);
    byCell.set(cell, (byCell.get(cell) ?? 0) + weights[i] * reduction);
  });
  const values = [...byCell.values()];
  const error = Math.sqrt(values.reduce((sum, value) => sum + value ** 2, 0));
  return values.reduce((sum, value) => sum + value, 0) / Math.max(error, EPSILON);
}

/** @param {Sample} point @param {Fit} fit */
function size(point, { logGains, biases }) {
  const values = CHANNELS.map((c) => {
    const fitted = [logGains[0][c], logGains[1][c], biases[0][c], biases[1][c]];
    return residual(point.first[c], point.second[c], fitted).value;
  });
  return Math.sqrt(values.reduce((sum, value) => sum + value ** 2, 0) / 3);
}

function weightedMedian(values, weights) {
  const order = values.map((_, index) => index).sort((a, b) => values[a] - values[b]);
  const half = weights.reduce((sum, weight) => sum + weight, 0) / 2;
  let total = 0;
  for (const index of order) {
    total += weights[index];
    if (total >= half) return values[index];
  }
  return 0;
}

function clip(value, least, most) {
  return Math.min(Math.max(value, least), most);
}
