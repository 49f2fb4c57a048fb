/**
 * SIFT (Lowe 2004) with the constants and the arithmetic of OpenCV's `cv2.SIFT`, so that the page finds the features
 * that the command finds.
 */

import { solve } from "./linear.js";
import { LAYERS, differences, gaussianPyramid } from "./scale_space.js";

const CONTRAST_THRESHOLD = 0.02;
const EDGE_THRESHOLD = 10;
const SIGMA = 1.6;
const BORDER = 5;
const MAX_STEPS = 5;
const UNIT = 1 / 255;
const ORIENTATION_BINS = 36;
const ORIENTATION_SIGMA = 1.5;
const ORIENTATION_RADIUS = 3 * ORIENTATION_SIGMA;
const PEAK_RATIO = 0.8;
const CELLS = 4;
const BINS = 8;
const CELL_WIDTH = 3;
const CLIP = 0.2;
const DESCRIPTOR_FACTOR = 512;
const DESCRIPTOR_LENGTH = CELLS * CELLS * BINS;

/**
 * keypoints: x and y in pixels, the centre of the top left pixel at 0.5, two numbers a feature. descriptors: RootSIFT,
 * 128 numbers a feature.
 * @typedef {{ count: number, keypoints: Float64Array, descriptors: Float32Array }} Features
 */

/** SIFT features of a grey image. @returns {Features} */
export function extractFeatures(grey, width, height, maxFeatures) {
  const pyramid = gaussianPyramid(grey, width, height);
  const found = strongest(withoutDuplicates(findKeypoints(pyramid)), maxFeatures);
  const keypoints = new Float64Array(2 * found.length);
  const descriptors = new Float32Array(DESCRIPTOR_LENGTH * found.length);
  found.forEach((point, index) => {
    keypoints[2 * index] = point.x / 2 + 0.5; // of the image, not of its double
    keypoints[2 * index + 1] = point.y / 2 + 0.5;
    describe(pyramid[point.octave][point.layer], point, descriptors.subarray(DESCRIPTOR_LENGTH * index));
  });
  return { count: found.length, keypoints, descriptors };
}

// ---- keypoints

function findKeypoints(pyramid) {
  const found = [];
  differences(pyramid).forEach((planes, octave) => {
    const { width, height } = planes[0];
    for (let layer = 1; layer <= LAYERS; layer++) {
      for (let row = BORDER; row < height - BORDER; row++) {
        for (let column = BORDER; column < width - BORDER; column++) {
          if (!isExtremum(planes, layer, row * width + column)) continue;
          const refined = refine(planes, octave, layer, row, column);
          if (refined) found.push(...orientations(pyramid[octave][refined.layer], refined));
        }
      }
    }
  });
  return found;
}

function isExtremum(planes, layer, index) {
  const { data, width } = planes[layer];
  const value = data[index];
  if (value === 0) return false;
  const sign = value > 0 ? 1 : -1;
  const size = value * sign;
  for (const plane of [planes[layer], planes[layer - 1], planes[layer + 1]]) {
    for (let row = -width; row <= width; row += width) {
      for (let column = -1; column <= 1; column++) {
        if (plane.data[index + row + column] * sign > size) return false;
      }
    }
  }
  return true;
}

/** Position of an extremum between pixels and layers; null where it is weak, on an edge, or leaves the image. */
function refine(planes, octave, layer, row, column) {
  const { width, height } = planes[0];
  for (let step = 0; step < MAX_STEPS; step++) {
    const { gradient, hessian } = derivatives(planes, layer, row * width + column);
    const shift = solve(hessian.map((line, index) => [...line, -gradient[index]]));
    if (shift.every((value) => Math.abs(value) < 0.5)) {
      const value = planes[layer].data[row * width + column] * UNIT;
      const contrast = value + 0.5 * shift.reduce((sum, part, index) => sum + part * gradient[index], 0);
      if (Math.abs(contrast) * LAYERS < CONTRAST_THRESHOLD || isEdge(hessian)) return null;
      const scale = 2 ** octave;
      const size = SIGMA * 2 ** ((layer + shift[2]) / LAYERS) * scale * 2;
      const [x, y] = [(column + shift[0]) * scale, (row + shift[1]) * scale].map(Math.fround);
      return { x, y, size: Math.fround(size), octave, layer, row, column, response: Math.abs(contrast) };
    }
    if (!shift.every((value) => Math.abs(value) < 2 ** 31 / 3)) return null;
    column += Math.round(shift[0]);
    row += Math.round(shift[1]);
    layer += Math.round(shift[2]);
    const inside = row >= BORDER && row < height - BORDER && column >= BORDER && column < width - BORDER;
    if (layer < 1 || layer > LAYERS || !inside) return null;
  }
  return null;
}

function derivatives(planes, layer, i) {
  const { data, width } = planes[layer];
  const [below, above] = [planes[layer - 1].data, planes[layer + 1].data];
  const twice = 2 * data[i];
  const gradient = [data[i + 1] - data[i - 1], data[i + width] - data[i - width], above[i] - below[i]];
  const xx = data[i + 1] + data[i - 1] - twice;
  const yy = data[i + width] + data[i - width] - twice;
  const ss = above[i] + below[i] - twice;
  const xy = (data[i + width + 1] - data[i + width - 1] - data[i - width + 1] + data[i - width - 1]) / 4;
  const xs = (above[i + 1] - above[i - 1] - below[i + 1] + below[i - 1]) / 4;
  const ys = (above[i + width] - above[i - width] - below[i + width] + below[i - width]) / 4;
  const hessian = [
    [xx, xy, xs],
    [xy, yy, ys],
    [xs, ys, ss],
  ];
  return { gradient: gradient.map((value) => value * 0.5 * UNIT), hessian: hessian.map((row) => row.map((v) => v * UNIT)) };
}

function isEdge(hessian) {
  const trace = hessian[0][0] + hessian[1][1];
  const determinant = hessian[0][0] * hessian[1][1] - hessian[0][1] ** 2;
  return determinant <= 0 || trace ** 2 * EDGE_THRESHOLD >= (EDGE_THRESHOLD + 1) ** 2 * determinant;
}

/** A keypoint for each dominant direction of the gradient. */
function orientations(plane, point) {
  const scale = (point.size * 0.5) / 2 ** point.octave;
  const histogram = directionHistogram(plane, point, Math.round(ORIENTATION_RADIUS * scale), ORIENTATION_SIGMA * scale);
  const threshold = Math.max(...histogram) * PEAK_RATIO;
  const found = [];
  for (let bin = 0; bin < ORIENTATION_BINS; bin++) {
    const left = histogram[(bin + ORIENTATION_BINS - 1) % ORIENTATION_BINS];
    const right = histogram[(bin + 1) % ORIENTATION_BINS];
    const value = histogram[bin];
    if (value > left && value > right && value >= threshold) {
      const peak = bin + (0.5 * (left - right)) / (left - 2 * value + right);
      const wrapped = (peak + ORIENTATION_BINS) % ORIENTATION_BINS;
      found.push({ ...point, angle: (360 - (360 / ORIENTATION_BINS) * wrapped) % 360 });
    }
  }
  return found;
}

function directionHistogram(plane, point, radius, sigma) {
  const { data, width, height } = plane;
  const raw = new Float64Array(ORIENTATION_BINS);
  for (let i = -radius; i <= radius; i++) {
    const y = point.row + i;
    if (y <= 0 || y >= height - 1) continue;
    for (let j = -radius; j <= radius; j++) {
      const x = point.column + j;
      if (x <= 0 || x >= width - 1) continue;
      const at = y * width + x;
      const [dx, dy] = [data[at + 1] - data[at - 1], data[at - width] - data[at + width]];
      const weight = Math.exp(-(i * i + j * j) / (2 * sigma * sigma));
      const bin = Math.round((ORIENTATION_BINS / 360) * direction(dy, dx));
      raw[(bin + ORIENTATION_BINS) % ORIENTATION_BINS] += weight * Math.sqrt(dx * dx + dy * dy);
    }
  }
  const at = (bin) => raw[(bin + ORIENTATION_BINS) % ORIENTATION_BINS];
  return Array.from(raw, (value, bin) => {
    return (at(bin - 2) + at(bin + 2)) / 16 + (at(bin - 1) + at(bin + 1)) / 4 + (value * 6) / 16;
  });
}

/** Direction in degrees, 0 to 360. */
function direction(dy, dx) {
  const degrees = (Math.atan2(dy, dx) * 180) / Math.PI;
  return degrees < 0 ? degrees + 360 : degrees;
}

/** Sorted by position, without repeated ones. */
function withoutDuplicates(points) {
  const order = (a, b) =>
    a.x - b.x || a.y - b.y || b.size - a.size || a.angle - b.angle || b.response - a.response || b.octave - a.octave;
  const same = (a, b) => a.x === b.x && a.y === b.y && a.size === b.size && a.angle === b.angle;
  return points.sort(order).filter((point, index, all) => index === 0 || !same(point, all[index - 1]));
}

/** Those of the largest response, in their order. */
function strongest(points, count) {
  if (points.length <= count) return points;
  const limit = points.map((point) => point.response).sort((a, b) => b - a)[count - 1];
  return points.filter((point) => point.response >= limit);
}

// ---- descriptors

/** Write the descriptor of a keypoint. @param {import("./scale_space.js").Plane} plane @param {Float32Array} out */
function describe(plane, point, out) {
  const histogram = gradientHistogram(plane, point);
  const values = new Float64Array(DESCRIPTOR_LENGTH);
  const side = BINS + 2;
  for (let row = 0; row < CELLS; row++) {
    for (let column = 0; column < CELLS; column++) {
      const from = ((row + 1) * (CELLS + 2) + column + 1) * side;
      histogram[from] += histogram[from + BINS]; // the circle of directions closes
      histogram[from + 1] += histogram[from + BINS + 1];
      for (let bin = 0; bin < BINS; bin++) values[(row * CELLS + column) * BINS + bin] = histogram[from + bin];
    }
  }
  const limit = Math.sqrt(values.reduce((sum, value) => sum + value * value, 0)) * CLIP;
  const clipped = values.map((value) => Math.min(value, limit));
  const length = Math.sqrt(clipped.reduce((sum, value) => sum + value * value, 0));
  const bytes = clipped.map((value) => Math.min(Math.round((value * DESCRIPTOR_FACTOR) / Math.max(length, 1e-7)), 255));
  const total = Math.max(bytes.reduce((sum, value) => sum + value, 0), 1e-12);
  for (let i = 0; i < DESCRIPTOR_LENGTH; i++) out[i] = Math.sqrt(bytes[i] / total);
}

function gradientHistogram(plane, point) {
  const { data, width, height } = plane;
  const unit = 2 ** point.octave;
  const [x, y] = [Math.round(point.x / unit), Math.round(point.y / unit)];
  const angle = (360 - point.angle) % 360;
  const cell = (CELL_WIDTH * point.size * 0.5) / unit;
  const reach = Math.round(cell * Math.SQRT2 * (CELLS + 1) * 0.5);
  const radius = Math.min(reach, Math.floor(Math.hypot(width, height)));
  const [cos, sin] = [Math.cos((angle * Math.PI) / 180) / cell, Math.sin((angle * Math.PI) / 180) / cell];
  const histogram = new Float64Array((CELLS + 2) * (CELLS + 2) * (BINS + 2));
  for (let i = -radius; i <= radius; i++) {
    const r = y + i;
    if (r <= 0 || r >= height - 1) continue;
    for (let j = -radius; j <= radius; j++) {
      const c = x + j;
      const [across, down] = [j * cos - i * sin, j * sin + i * cos];
      const [rowBin, columnBin] = [down + CELLS / 2 - 0.5, across + CELLS / 2 - 0.5];
      const inside = rowBin > -1 && rowBin < CELLS && columnBin > -1 && columnBin < CELLS;
      if (!inside || c <= 0 || c >= width - 1) continue;
      const at = r * width + c;
      const [dx, dy] = [data[at + 1] - data[at - 1], data[at - width] - data[at + width]];
      const weight = Math.exp((across * across + down * down) / (-0.5 * CELLS * CELLS));
      const bin = ((direction(dy, dx) - angle) * BINS) / 360;
      spread(histogram, rowBin, columnBin, bin, Math.sqrt(dx * dx + dy * dy) * weight);
    }
  }
  return histogram;
}

/** Add a value to the eight nearest bins. */
function spread(histogram, rowBin, columnBin, directionBin, value) {
  const [row, column, whole] = [Math.floor(rowBin), Math.floor(columnBin), Math.floor(directionBin)];
  const [r, c, d] = [rowBin - row, columnBin - column, directionBin - whole];
  const bin = (whole + 2 * BINS) % BINS;
  for (let i = 0; i < 2; i++) {
    for (let j = 0; j < 2; j++) {
      const part = value * (i ? r : 1 - r) * (j ? c : 1 - c);
      const at = ((row + 1 + i) * (CELLS + 2) + column + 1 + j) * (BINS + 2) + bin;
      histogram[at] += part * (1 - d);
      histogram[at + 1] += part * d;
    }
  }
}
