/**
 * Relative pose of two views from matched normalised image coordinates, with outliers.
 *
 * Gauss-Newton steps minimise the Sampson distances with Cauchy weights, whose width shrinks to the tolerance (graduated
 * non-convexity), from the rotation that alone explains the matches best several others and several directions of
 * translation. The pose with most points in front of both cameras is kept.
 */

import { cross, dot, invertRigid, makePose, multiply, nearestRotation, norm, positionOf, rotate, rotationOf, solve, subtract } from "./linear.js";
import { triangulate } from "./matching.js";

const ROTATION_STEPS = 20;
const START_ANGLE = 0.3; // radians; a sideways translation looks much like a rotation
const WIDTHS = [64, 32, 16, 8, 4, 2, 1, 1, 1, 1, 1, 1]; // of the weights in each step, in tolerances
const STEP = 1e-6; // for numeric derivatives, in radians
const DAMPING = 1e-9;
const EPSILON = 1e-12;

/**
 * pose: of the first camera in the second's frame, with a baseline of 1. points: inliers in the first camera's frame.
 * matches: those of the points. parallax: the median angle of their viewing rays, in degrees.
 * @typedef {{ pose: number[], points: number[][], matches: number[][][], parallax: number }} TwoViewGeometry
 */

/**
 * The relative pose with most inliers.
 * @param {number[][][]} matches pairs of normalised image coordinates
 * @param {number} tolerance largest Sampson distance of an inlier
 * @returns {TwoViewGeometry}
 */
export function estimateRelativePose(matches, tolerance) {
  const flat = Float64Array.from(matches.flat(2));
  const { rotation } = rotationAlone(matches, tolerance);
  let best = null;
  for (const turn of turns()) {
    for (const direction of directions()) {
      const pose = refine(flat, makePose(multiply(turn, rotation, 3), direction), tolerance);
      for (const sign of [1, -1]) {
        const signed = makePose(rotationOf(pose), positionOf(pose).map((value) => sign * value));
        const found = triangulateInliers(matches, flat, signed, tolerance);
        if (best === null || found.points.length > best.points.length) best = found;
      }
    }
  }
  return /** @type {TwoViewGeometry} */ (best);
}

/**
 * The rotation that fits the viewing rays best, by reweighted least squares (Kabsch), and the share of the matches that
 * it explains.
 */
export function rotationAlone(matches, tolerance) {
  const rays = matches.map((pair) => pair.map(([x, y]) => [x, y, 1].map((value) => value / Math.hypot(x, y, 1))));
  let rotation = [1, 0, 0, 0, 1, 0, 0, 0, 1];
  let errors = rays.map(() => 0);
  for (let step = 0; step < ROTATION_STEPS; step++) {
    const sums = new Array(9).fill(0);
    let total = 0;
    rays.forEach(([a, b], index) => {
      const weight = 1 / (1 + (errors[index] / tolerance) ** 2);
      total += weight;
      for (let entry = 0; entry < 9; entry++) sums[entry] += weight * b[Math.floor(entry / 3)] * a[entry % 3];
    });
    rotation = nearestRotation(sums.map((value) => value / total));
    errors = rays.map(([a, b]) => norm(subtract(rotate(rotation, a), b)));
  }
  return { rotation, share: errors.filter((error) => error < tolerance).length / rays.length };
}

/** No rotation, and rotations to all sides. */
function turns() {
  const vectors = [[0, 0, 0]];
  for (const angle of [START_ANGLE, -START_ANGLE]) vectors.push([angle, 0, 0], [0, angle, 0]);
  return vectors.map(fromRotationVector);
}

/** Half of the 26 directions to the neighbours in a grid: the other half has the opposite sign. */
function directions() {
  const found = [];
  for (let index = 14; index < 27; index++) {
    const vector = [(index % 3) - 1, (Math.floor(index / 3) % 3) - 1, Math.floor(index / 9) - 1];
    found.push(vector.map((value) => value / norm(vector)));
  }
  return found;
}

function refine(flat, pose, tolerance) {
  for (const width of WIDTHS) {
    const errors = sampsonDistances(flat, pose);
    const shifted = [0, 1, 2, 3, 4].map((index) => {
      const change = [0, 0, 0, 0, 0];
      change[index] = STEP;
      return sampsonDistances(flat, perturb(pose, change));
    });
    const rows = Array.from({ length: 5 }, (_, i) => Array.from({ length: 6 }, (__, j) => (i === j ? DAMPING : 0)));
    const jacobian = [0, 0, 0, 0, 0];
    for (let match = 0; match < errors.length; match++) {
      const error = errors[match];
      const weight = 1 / (1 + (error / (width * tolerance)) ** 2);
      for (let i = 0; i < 5; i++) jacobian[i] = (shifted[i][match] - error) / STEP;
      for (let i = 0; i < 5; i++) {
        for (let j = 0; j < 5; j++) rows[i][j] += weight * jacobian[i] * jacobian[j];
        rows[i][5] -= weight * jacobian[i] * error;
      }
    }
    const change = solve(rows);
    if (!change.every(Number.isFinite)) return pose;
    pose = perturb(pose, change);
  }
  return pose;
}

/** Signed first-order geometric errors. @param {Float64Array} flat x and y in the first view and in the second */
function sampsonDistances(flat, pose) {
  const [x, y, z] = positionOf(pose);
  const e = multiply([0, -z, y, z, 0, -x, -y, x, 0], rotationOf(pose), 3);
  const errors = new Float64Array(flat.length / 4);
  for (let match = 0; match < errors.length; match++) {
    const [u, v, s, t] = [flat[4 * match], flat[4 * match + 1], flat[4 * match + 2], flat[4 * match + 3]];
    const [l0, l1, l2] = [e[0] * u + e[1] * v + e[2], e[3] * u + e[4] * v + e[5], e[6] * u + e[7] * v + e[8]];
    const [b0, b1] = [e[0] * s + e[3] * t + e[6], e[1] * s + e[4] * t + e[7]];
    errors[match] = (s * l0 + t * l1 + l2) / Math.sqrt(Math.max(l0 * l0 + l1 * l1 + b0 * b0 + b1 * b1, EPSILON));
  }
  return errors;
}

/** A pose after a change: a rotation vector, and two components of translation in the plane tangent to it. */
function perturb(pose, change) {
  const position = positionOf(pose);
  const smallest = position.map(Math.abs).indexOf(Math.min(...position.map(Math.abs)));
  const first = unit(cross(position, [0, 1, 2].map((axis) => (axis === smallest ? 1 : 0))));
  const second = cross(position, first);
  const moved = position.map((value, axis) => value + change[3] * first[axis] + change[4] * second[axis]);
  return makePose(multiply(fromRotationVector(change.slice(0, 3)), rotationOf(pose), 3), unit(moved));
}

/** Rodrigues' formula. @param {number[]} vector axis times angle in radians */
function fromRotationVector(vector) {
  const angle = norm(vector);
  if (angle === 0) return [1, 0, 0, 0, 1, 0, 0, 0, 1];
  const [x, y, z] = vector.map((value) => value / angle);
  const [s, c] = [Math.sin(angle), 1 - Math.cos(angle)];
  const cosine = 1 - c;
  return [
    ...[cosine + x * x * c, x * y * c - z * s, x * z * c + y * s],
    ...[y * x * c + z * s, cosine + y * y * c, y * z * c - x * s],
    ...[z * x * c - y * s, z * y * c + x * s, cosine + z * z * c],
  ];
}

function triangulateInliers(matches, flat, pose, tolerance) {
  const errors = sampsonDistances(flat, pose);
  const centre = positionOf(invertRigid(pose));
  const [points, inliers, angles] = [[], [], []];
  matches.forEach((match, index) => {
    if (Math.abs(errors[index]) >= tolerance) return;
    const point = triangulate(match[0], match[1], pose);
    if (!(point[2] > 0 && dot(pose.slice(8, 11), point) + pose[11] > 0)) return;
    points.push(point);
    inliers.push(match);
    const other = subtract(point, centre);
    angles.push(Math.atan2(norm(cross(point, other)), dot(point, other)));
  });
  angles.sort((a, b) => a - b);
  const parallax = angles.length > 0 ? (angles[angles.length >> 1] * 180) / Math.PI : 0;
  return { pose, points, matches: inliers, parallax };
}

function unit(vector) {
  return vector.map((value) => value / norm(vector));
}
