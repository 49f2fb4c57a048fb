/**
 * Resampling of 8-bit images with the arithmetic of OpenCV, so that the network sees the same pixels as it does with
 * the command.
 */

import { roundHalfEven } from "./linear.js";

/** @typedef {{ data: Uint8Array | Uint8ClampedArray, width: number, height: number, channels: number }} Image */

const CUBIC_A = -0.75;
const RESIZE_BITS = 11; // of the fixed-point weights of a cubic resize
const TINY = 1e-3; // weights below it are left out by OpenCV

/** Resize by the mean of the area that each pixel covers (cv2.INTER_AREA). @param {Image} image */
export function resizeArea(image, width, height) {
  const { data, channels } = image;
  if (width === image.width && height === image.height) return image;
  const columns = areaWeights(image.width, width);
  const rows = areaWeights(image.height, height);
  const stride = width * channels;
  const line = new Float32Array(stride);
  const sum = new Float32Array(stride);
  const out = new Uint8Array(stride * height);
  for (let y = 0; y < height; y++) {
    sum.fill(0);
    for (const [sourceRow, rowWeight] of rows[y]) {
      line.fill(0);
      for (let x = 0; x < width; x++) {
        for (const [sourceColumn, weight] of columns[x]) {
          const from = (sourceRow * image.width + sourceColumn) * channels;
          for (let c = 0; c < channels; c++) line[x * channels + c] += data[from + c] * weight;
        }
      }
      for (let i = 0; i < stride; i++) sum[i] += line[i] * rowWeight;
    }
    for (let i = 0; i < stride; i++) out[y * stride + i] = roundHalfEven(sum[i]);
  }
  return { data: out, width, height, channels };
}

/** For each new pixel of one axis, the old ones that it covers: [index, weight]. */
function areaWeights(from, to) {
  const scale = from / to;
  const weights = [];
  for (let index = 0; index < to; index++) {
    const start = index * scale;
    const end = start + scale;
    const cell = Math.min(scale, from - start);
    const first = Math.ceil(start);
    const last = Math.max(Math.min(Math.floor(end), from - 1), first);
    const own = [];
    if (first - start > TINY) own.push([first - 1, Math.fround((first - start) / cell)]);
    for (let k = first; k < Math.min(last, Math.floor(end)); k++) own.push([k, Math.fround(1 / cell)]);
    if (end - last > TINY && last < from) {
      own.push([last, Math.fround(Math.min(Math.min(end - last, 1), cell) / cell)]);
    }
    weights.push(own);
  }
  return weights;
}

/** Resize by cubic interpolation (cv2.INTER_CUBIC), for larger images. @param {Image} image */
export function resizeCubic(image, width, height) {
  const { data, channels } = image;
  if (width === image.width && height === image.height) return image;
  const columns = cubicWeights(image.width, width);
  const rows = cubicWeights(image.height, height);
  const stride = width * channels;
  const lines = new Float64Array(stride * image.height);
  for (let y = 0; y < image.height; y++) {
    for (let x = 0; x < width; x++) {
      for (const [source, weight] of columns[x]) {
        const from = (y * image.width + source) * channels;
        for (let c = 0; c < channels; c++) lines[y * stride + x * channels + c] += data[from + c] * weight;
      }
    }
  }
  const out = new Uint8ClampedArray(stride * height);
  const unit = 2 ** (2 * RESIZE_BITS);
  for (let y = 0; y < height; y++) {
    for (let i = 0; i < stride; i++) {
      let sum = 0;
      for (const [source, weight] of rows[y]) sum += lines[source * stride + i] * weight;
      out[y * stride + i] = Math.floor((sum + unit / 2) / unit);
    }
  }
  return { data: out, width, height, channels };
}

function cubicWeights(from, to) {
  const weights = [];
  for (let index = 0; index < to; index++) {
    const position = Math.fround((index + 0.5) * (from / to) - 0.5);
    const base = Math.floor(position);
    const t = position - base;
    const near = (d) => ((CUBIC_A + 2) * d - (CUBIC_A + 3)) * d * d + 1;
    const far = (d) => ((CUBIC_A * d - 5 * CUBIC_A) * d + 8 * CUBIC_A) * d - 4 * CUBIC_A;
    const values = [far(t + 1), near(t), near(1 - t)];
    values.push(1 - values[0] - values[1] - values[2]);
    weights.push(
      values.map((value, k) => {
        const source = Math.min(Math.max(base - 1 + k, 0), from - 1);
        return [source, roundHalfEven(value * 2 ** RESIZE_BITS)];
      }),
    );
  }
  return weights;
}

/**
 * Bilinear samples at given positions, with the border repeated (cv2.remap).
 * @param {Image} image @param {(x: number, y: number) => [number, number]} source position of each new pixel
 */
export function remap(image, source) {
  const { data, width, height, channels } = image;
  const out = new Uint8Array(width * height * channels);
  const last = { x: width - 1, y: height - 1 };
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      const position = source(x, y);
      const [u, v] = [Math.fround(position[0]), Math.fround(position[1])];
      const [x0, y0] = [Math.floor(u), Math.floor(v)];
      const [fx, fy] = [u - x0, v - y0];
      const left = Math.min(Math.max(x0, 0), last.x);
      const right = Math.min(Math.max(x0 + 1, 0), last.x);
      const top = Math.min(Math.max(y0, 0), last.y) * width;
      const bottom = Math.min(Math.max(y0 + 1, 0), last.y) * width;
      for (let c = 0; c < channels; c++) {
        const a = data[(top + left) * channels + c];
        const b = data[(top + right) * channels + c];
        const d = data[(bottom + left) * channels + c];
        const e = data[(bottom + right) * channels + c];
        const upper = a + fx * (b - a);
        const lower = d + fx * (e - d);
        out[(y * width + x) * channels + c] = roundHalfEven(upper + fy * (lower - upper));
      }
    }
  }
  return { data: out, width, height, channels };
}

/** Grey of an RGB image, as cv2.cvtColor computes it. @param {Image} image */
export function toGrey(image) {
  const { data, width, height } = image;
  const grey = new Uint8Array(width * height);
  for (let i = 0; i < grey.length; i++) {
    grey[i] = (data[3 * i] * 9798 + data[3 * i + 1] * 19235 + data[3 * i + 2] * 3735 + 16384) >> 15;
  }
  return { data: grey, width, height, channels: 1 };
}
