/** Matches of features between views whose cameras are known, and their triangulation. */

import { cross, dot, invertRigid, multiply, norm, positionOf, rotate, rotationOf, subtract, transpose3 } from "./linear.js";

const MAX_RATIO = 0.8; // of the distances of the best and the second best match
const MAX_EPIPOLAR_ERROR = 1.5; // pixels
const MIN_PARALLAX_DEG = 0.3; // with less, a triangulated depth is mostly noise
const LENGTH = 128; // of a descriptor
const EPSILON = 1e-12;

/** Index pairs of mutual nearest neighbours that pass the ratio test. @param {import("./sift.js").Features} first */
export function matchFeatures(first, second) {
  if (Math.min(first.count, second.count) < 2) return [];
  const [n, m] = [first.count, second.count];
  const best = new Float32Array(n).fill(-1);
  const next = new Float32Array(n).fill(-1);
  const forward = new Int32Array(n);
  const backward = new Int32Array(m);
  const bestBack = new Float32Array(m).fill(-1);
  for (let i = 0; i < n; i++) {
    const a = first.descriptors.subarray(i * LENGTH, (i + 1) * LENGTH);
    for (let j = 0; j < m; j++) {
      const similarity = Math.fround(product(a, second.descriptors, j * LENGTH));
      if (similarity > best[i]) {
        next[i] = best[i];
        best[i] = similarity;
        forward[i] = j;
      } else if (similarity > next[i]) next[i] = similarity;
      if (similarity > bestBack[j]) {
        bestBack[j] = similarity;
        backward[j] = i;
      }
    }
  }
  const pairs = [];
  for (let i = 0; i < n; i++) {
    if (backward[forward[i]] === i && 1 - best[i] < MAX_RATIO ** 2 * (1 - next[i])) pairs.push([i, forward[i]]);
  }
  return pairs;
}

function product(a, b, from) {
  let [s0, s1, s2, s3] = [0, 0, 0, 0];
  for (let k = 0; k < LENGTH; k += 4) {
    s0 += a[k] * b[from + k];
    s1 += a[k + 1] * b[from + k + 1];
    s2 += a[k + 2] * b[from + k + 2];
    s3 += a[k + 3] * b[from + k + 3];
  }
  return s0 + s1 + s2 + s3;
}

/** (X / Z, Y / Z) of a feature. @param {import("./sift.js").Features} features @param {number[]} K */
export function normalizedPoint(features, index, [fx, fy, cx, cy]) {
  return [(features.keypoints[2 * index] - cx) / fx, (features.keypoints[2 * index + 1] - cy) / fy];
}

/** Pose of the first camera in the frame of the second. */
export function relativePose(firstPose, secondPose) {
  return multiply(invertRigid(secondPose), firstPose, 4);
}

/**
 * Matches that fit the cameras, as pairs of normalised image coordinates.
 * @param {number[][]} pairs from `matchFeatures` @param {number[]} pose of the first camera in the second's frame
 */
export function alongEpipolarLines(pairs, first, second, firstK, secondK, pose) {
  const limit = MAX_EPIPOLAR_ERROR / Math.sqrt(firstK[0] * secondK[0]);
  return pairs
    .map(([i, j]) => [normalizedPoint(first, i, firstK), normalizedPoint(second, j, secondK)])
    .filter(([a, b]) => Math.abs(sampsonDistance(a, b, essentialMatrix(pose))) < limit);
}

/** E = [t]x R. @param {number[]} pose */
export function essentialMatrix(pose) {
  const [x, y, z] = positionOf(pose);
  return multiply([0, -z, y, z, 0, -x, -y, x, 0], rotationOf(pose), 3);
}

/** First-order geometric error of a match, with its sign, in normalised image coordinates. */
export function sampsonDistance(a, b, essential) {
  const line = rotate(essential, [...a, 1]);
  const back = rotate(transpose3(essential), [...b, 1]);
  const gradient = line[0] ** 2 + line[1] ** 2 + back[0] ** 2 + back[1] ** 2;
  return dot([...b, 1], line) / Math.sqrt(Math.max(gradient, EPSILON));
}

/** The midpoint of the closest points of two viewing rays, in the first camera's frame. */
export function triangulate(a, b, pose) {
  const back = invertRigid(pose);
  const centre = positionOf(back);
  const unit = (vector) => vector.map((value) => value / norm(vector));
  const first = unit([...a, 1]);
  const second = unit(rotate(rotationOf(back), [...b, 1]));
  const cosine = dot(first, second);
  const sineSquared = Math.max(1 - cosine ** 2, EPSILON);
  const s = (dot(first, centre) - cosine * dot(second, centre)) / sineSquared;
  const t = (cosine * dot(first, centre) - dot(second, centre)) / sineSquared;
  return [0, 1, 2].map((axis) => (s * first[axis] + centre[axis] + t * second[axis]) / 2);
}

/** Depths of matches in both cameras, those with little parallax left out: first all in one, then in the other. */
export function triangulatedDepths(matches, pose) {
  const centre = positionOf(invertRigid(pose));
  const [inFirst, inSecond] = [[], []];
  for (const [a, b] of matches) {
    const point = triangulate(a, b, pose);
    const depth = rotate(rotationOf(pose), point)[2] + pose[11];
    const other = subtract(point, centre);
    const angle = (Math.atan2(norm(cross(point, other)), dot(point, other)) * 180) / Math.PI;
    if (point[2] > 0 && depth > 0 && angle > MIN_PARALLAX_DEG) {
      inFirst.push(point[2]);
      inSecond.push(depth);
    }
  }
  return [...inFirst, ...inSecond];
}
