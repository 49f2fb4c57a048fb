/** Gaussian pyramids of grey images in floating point, as OpenCV's SIFT builds them. */

/** @typedef {{ data: Float32Array, width: number, height: number }} Plane */

export const LAYERS = 3; // of an octave
const SIGMA = 1.6;
const INPUT_BLUR = 0.5; // of the image as it is

/** Octaves of `LAYERS` + 3 blurred planes, the first at twice the image's size. @param {Uint8Array} grey */
export function gaussianPyramid(grey, width, height) {
  const twice = doubled(grey, width, height);
  const first = blur(twice, Math.sqrt(Math.max(SIGMA ** 2 - 4 * INPUT_BLUR ** 2, 0.01)));
  const octaves = Math.round(Math.log2(Math.min(twice.width, twice.height)) - 2) + 1;
  const step = 2 ** (1 / LAYERS);
  const pyramid = [];
  for (let octave = 0; octave < octaves; octave++) {
    const planes = [octave === 0 ? first : halved(pyramid[octave - 1][LAYERS])];
    for (let layer = 1; layer < LAYERS + 3; layer++) {
      const before = SIGMA * step ** (layer - 1);
      planes.push(blur(planes[layer - 1], Math.sqrt((before * step) ** 2 - before ** 2)));
    }
    pyramid.push(planes);
  }
  return pyramid;
}

/** Differences of neighbouring planes of a pyramid. @param {Plane[][]} pyramid */
export function differences(pyramid) {
  return pyramid.map((planes) =>
    planes.slice(1).map((plane, index) => {
      const data = new Float32Array(plane.data.length);
      for (let i = 0; i < data.length; i++) data[i] = plane.data[i] - planes[index].data[i];
      return { data, width: plane.width, height: plane.height };
    }),
  );
}

/** The image at twice its size, pixel (x, y) at (2 x, 2 y). */
function doubled(grey, width, height) {
  const out = new Float32Array(4 * width * height);
  const at = (x, y) => grey[Math.min(y, height - 1) * width + Math.min(x, width - 1)];
  for (let y = 0; y < 2 * height; y++) {
    const [top, lower] = [y >> 1, (y + 1) >> 1];
    for (let x = 0; x < 2 * width; x++) {
      const [left, right] = [x >> 1, (x + 1) >> 1];
      out[y * 2 * width + x] = (at(left, top) + at(right, top) + at(left, lower) + at(right, lower)) / 4;
    }
  }
  return { data: out, width: 2 * width, height: 2 * height };
}

function halved(plane) {
  const [width, height] = [plane.width >> 1, plane.height >> 1];
  const data = new Float32Array(width * height);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) data[y * width + x] = plane.data[2 * y * plane.width + 2 * x];
  }
  return { data, width, height };
}

/** Gaussian blur, mirrored at the border. @param {Plane} plane @param {number} sigma @returns {Plane} */
export function blur(plane, sigma) {
  const { width, height } = plane;
  const kernel = gaussianKernel(sigma);
  const rows = new Float32Array(width * height);
  const data = new Float32Array(width * height);
  const radius = kernel.length >> 1;
  const line = new Float64Array(width + 2 * radius);
  for (let y = 0; y < height; y++) {
    for (let k = 0; k < line.length; k++) line[k] = plane.data[y * width + mirror(k - radius, width)];
    for (let x = 0; x < width; x++) {
      let sum = kernel[radius] * line[x + radius];
      for (let k = 1; k <= radius; k++) sum += kernel[radius + k] * (line[x + radius - k] + line[x + radius + k]);
      rows[y * width + x] = sum;
    }
  }
  const sums = new Float64Array(width);
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) sums[x] = kernel[radius] * rows[y * width + x];
    for (let k = 1; k <= radius; k++) {
      const [above, below] = [mirror(y - k, height) * width, mirror(y + k, height) * width];
      for (let x = 0; x < width; x++) sums[x] += kernel[radius + k] * (rows[above + x] + rows[below + x]);
    }
    data.set(sums, y * width);
  }
  return { data, width, height };
}

function gaussianKernel(sigma) {
  const size = Math.round(sigma * 8 + 1) | 1;
  const centre = size >> 1;
  const values = Array.from({ length: size }, (_, i) => Math.exp(-((i - centre) ** 2) / (2 * sigma * sigma)));
  const sum = values.reduce((a, b) => a + b, 0);
  return values.map((value) => Math.fround(value / sum));
}

/** Index inside 0 to size - 1, mirrored at the outermost pixels. */
function mirror(index, size) {
  if (size === 1) return 0;
  let inside = index;
  while (inside < 0 || inside >= size) inside = inside < 0 ? -inside : 2 * size - 2 - inside;
  return inside;
}
