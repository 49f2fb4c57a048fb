/**
 * Small matrices as plain arrays, row by row: 3x3 has 9 numbers; a pose is 4x4 and has 16, camera-to-world with OpenCV
 * axes.
 */

/** @typedef {number[]} Matrix */

/** Product of two matrices of n rows and columns. @param {Matrix} a @param {Matrix} b @param {number} n */
export function multiply(a, b, n) {
  const product = new Array(n * n).fill(0);
  for (let i = 0; i < n; i++) {
    for (let j = 0; j < n; j++) {
      for (let k = 0; k < n; k++) product[i * n + j] += a[i * n + k] * b[k * n + j];
    }
  }
  return product;
}

/** Inverse of a 3x3 matrix; NaN where it is singular. @param {Matrix} m */
export function invert3(m) {
  const [a, b, c, d, e, f, g, h, i] = m;
  const cofactors = [e * i - f * h, c * h - b * i, b * f - c * e, f * g - d * i, a * i - c * g, c * d - a * f];
  cofactors.push(d * h - e * g, b * g - a * h, a * e - b * d);
  const determinant = a * cofactors[0] + b * cofactors[3] + c * cofactors[6];
  return cofactors.map((value) => value / determinant);
}

/** @param {Matrix} m */
export function transpose3(m) {
  return [m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8]];
}

/** Rotation of a pose, 3x3. @param {Matrix} pose */
export function rotationOf(pose) {
  return [pose[0], pose[1], pose[2], pose[4], pose[5], pose[6], pose[8], pose[9], pose[10]];
}

/** Position of a pose. @param {Matrix} pose */
export function positionOf(pose) {
  return [pose[3], pose[7], pose[11]];
}

/** @param {Matrix} rotation @param {number[]} position */
export function makePose(rotation, position) {
  const r = rotation;
  const [x, y, z] = position;
  return [r[0], r[1], r[2], x, r[3], r[4], r[5], y, r[6], r[7], r[8], z, 0, 0, 0, 1];
}

/** @param {Matrix} rotation 3x3 @param {number[]} vector */
export function rotate(rotation, vector) {
  const [x, y, z] = vector;
  return [0, 3, 6].map((row) => rotation[row] * x + rotation[row + 1] * y + rotation[row + 2] * z);
}

/** Inverse of a rigid pose. @param {Matrix} pose */
export function invertRigid(pose) {
  const back = transpose3(rotationOf(pose));
  return makePose(back, rotate(back, positionOf(pose)).map((value) => -value));
}

/** The rotation nearest to a matrix that is one but for rounding, by Newton's iteration. @param {Matrix} matrix */
export function nearestRotation(matrix) {
  let rotation = matrix;
  for (let step = 0; step < 20; step++) {
    const other = transpose3(invert3(rotation));
    rotation = rotation.map((value, index) => (value + other[index]) / 2);
  }
  return rotation;
}

/** @param {number[]} a @param {number[]} b */
export function dot(a, b) {
  return a.reduce((sum, value, index) => sum + value * b[index], 0);
}

/** @param {number[]} a @param {number[]} b */
export function cross(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** @param {number[]} vector */
export function norm(vector) {
  return Math.hypot(...vector);
}

/** @param {number[]} a @param {number[]} b */
export function subtract(a, b) {
  return a.map((value, index) => value - b[index]);
}

/** Solution of n linear equations, by elimination with pivots. @param {number[][]} rows n rows of n + 1 numbers */
export function solve(rows) {
  const n = rows.length;
  const work = rows.map((row) => [...row]);
  for (let column = 0; column < n; column++) {
    let pivot = column;
    for (let row = column + 1; row < n; row++) {
      if (Math.abs(work[row][column]) > Math.abs(work[pivot][column])) pivot = row;
    }
    [work[column], work[pivot]] = [work[pivot], work[column]];
    for (let row = column + 1; row < n; row++) {
      const factor = work[row][column] / work[column][column];
      for (let k = column; k <= n; k++) work[row][k] -= factor * work[column][k];
    }
  }
  const solution = new Array(n).fill(0);
  for (let row = n - 1; row >= 0; row--) {
    let value = work[row][n];
    for (let k = row + 1; k < n; k++) value -= work[row][k] * solution[k];
    solution[row] = value / work[row][row];
  }
  return solution;
}

/** Percentile with linear interpolation, as NumPy has it. @param {number[]} values sorted @param {number} percent */
export function percentile(values, percent) {
  const position = ((values.length - 1) * percent) / 100;
  const below = Math.floor(position);
  const above = Math.min(below + 1, values.length - 1);
  return values[below] + (position - below) * (values[above] - values[below]);
}

/** Rounding to the nearest whole number, halves to the even one, as Python and OpenCV do. @param {number} value */
export function roundHalfEven(value) {
  const floor = Math.floor(value);
  const rest = value - floor;
  if (rest !== 0.5) return Math.round(value);
  return floor % 2 === 0 ? floor : floor + 1;
}
