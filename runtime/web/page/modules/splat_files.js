/** Splat files: .ply in the layout of 3DGS, and .spz version 3 (nianticlabs/spz). */

/**
 * Gaussians with gsplat's names and units. means, scales: three numbers each. quats: w x y z. opacities: 0 to 1.
 * sh: coefficients, then channels.
 * @typedef {object} Gaussians
 * @property {number} count
 * @property {Float32Array} means
 * @property {Float32Array} scales
 * @property {Float32Array} quats
 * @property {Float32Array} opacities
 * @property {Float32Array} sh
 */

const MIN_OPACITY = 1e-6; // logits must be finite
const MIN_SCALE = 1e-30;

/** @param {Gaussians} gaussians @returns {Blob} */
export function toPly(gaussians) {
  const { count, means, scales, quats, opacities, sh } = gaussians;
  const channels = sh.length / count;
  const rest = channels / 3 - 1; // coefficients of degree 1 and more
  const names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"];
  for (let k = 0; k < 3 * rest; k++) names.push(`f_rest_${k}`);
  names.push("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3");
  const header =
    `ply\nformat binary_little_endian 1.0\nelement vertex ${count}\n` +
    names.map((name) => `property float ${name}\n`).join("") +
    "end_header\n";
  const rows = new Float32Array(count * names.length);
  for (let i = 0, at = 0; i < count; i++, at += names.length) {
    rows.set(means.subarray(3 * i, 3 * i + 3), at);
    rows.set(sh.subarray(channels * i, channels * i + 3), at + 6);
    for (let k = 0; k < 3 * rest; k++) {
      rows[at + 9 + k] = sh[channels * i + 3 * (1 + (k % rest)) + Math.floor(k / rest)];
    }
    const last = at + names.length - 8;
    const opacity = Math.min(Math.max(opacities[i], MIN_OPACITY), 1 - MIN_OPACITY);
    rows[last] = Math.log(opacity / (1 - opacity));
    for (let axis = 0; axis < 3; axis++) rows[last + 1 + axis] = Math.log(Math.max(scales[3 * i + axis], MIN_SCALE));
    rows.set(quats.subarray(4 * i, 4 * i + 4), last + 4);
  }
  return new Blob([header, rows], { type: "application/octet-stream" });
}

const MAGIC = 0x5053474e;
const VERSION = 3;
const MAX_FRACTIONAL_BITS = 24;
const POSITION_LIMIT = 2 ** 23 - 1;
const QUAT_STEPS = 511 / Math.SQRT1_2;
// Signs of SH coefficients in .spz's frame, which is turned by 180 degrees about x.
const SH_SIGNS = [1, -1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1];
const SIGNS = [1, -1, -1];

/** @param {Gaussians} gaussians @returns {Promise<Blob>} */
export async function toSpz(gaussians) {
  const { count, means, scales, quats, opacities, sh } = gaussians;
  const coefficients = sh.length / count / 3;
  const degree = Math.sqrt(coefficients) - 1;
  const largest = means.reduce((most, value) => Math.max(most, Math.abs(value)), 0);
  let bits = MAX_FRACTIONAL_BITS;
  while (bits > 0 && Math.round(largest * 2 ** bits) > POSITION_LIMIT) bits -= 1;
  const header = new DataView(new ArrayBuffer(16));
  [MAGIC, VERSION, count].forEach((value, index) => header.setUint32(4 * index, value, true));
  [degree, bits, 0, 0].forEach((value, index) => header.setUint8(12 + index, value));
  const positions = new Uint8Array(9 * count);
  means.forEach((value, i) => {
    const fixed = Math.round(value * SIGNS[i % 3] * 2 ** bits);
    for (let byte = 0; byte < 3; byte++) positions[3 * i + byte] = (fixed >> (8 * byte)) & 255;
  });
  const colours = new Uint8ClampedArray(3 * count);
  const rest = new Uint8ClampedArray(3 * (coefficients - 1) * count);
  for (let i = 0; i < count; i++) {
    for (let k = 0; k < 3; k++) colours[3 * i + k] = sh[3 * coefficients * i + k] * 0.15 * 255 + 127.5;
    for (let k = 3; k < 3 * coefficients; k++) {
      const value = sh[3 * coefficients * i + k] * SH_SIGNS[Math.floor(k / 3)];
      rest[3 * (coefficients - 1) * i + k - 3] = value * 128 + 128;
    }
  }
  const parts = [
    header,
    positions,
    Uint8ClampedArray.from(opacities, (value) => value * 255),
    colours,
    Uint8ClampedArray.from(scales, (value) => (Math.log(value) + 10) * 16),
    packRotations(quats, count),
    rest,
  ];
  const packed = new Blob(parts).stream().pipeThrough(new CompressionStream("gzip"));
  return new Response(packed).blob();
}

/** The index of the largest of x y z w in 2 bits, then the others as sign and 9-bit magnitude. */
function packRotations(quats, count) {
  const words = new Uint32Array(count);
  for (let i = 0; i < count; i++) {
    const [w, x, y, z] = quats.subarray(4 * i, 4 * i + 4);
    const length = Math.hypot(w, x, y, z);
    const values = [x, -y, -z, w].map((value) => value / length);
    const sizes = values.map(Math.abs);
    const largest = sizes.indexOf(Math.max(...sizes));
    const sign = values[largest] < 0 ? -1 : 1;
    let word = largest;
    values.forEach((value, k) => {
      if (k !== largest) word = (word * 2 + (value * sign < 0 ? 1 : 0)) * 512 + Math.round(sizes[k] * QUAT_STEPS);
    });
    words[i] = word;
  }
  return new Uint8Array(words.buffer);
}
