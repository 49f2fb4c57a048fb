/** Selection of two views of several: the pair with the largest overlap and the best parallax. */

import { InputError } from "./errors.js";
import { MIN_POINTS } from "./depth_range.js";
import { norm, positionOf, rotate, rotationOf, roundHalfEven, subtract, transpose3, dot, percentile } from "./linear.js";
import { alongEpipolarLines, matchFeatures, relativePose, triangulatedDepths } from "./matching.js";

const IDEAL_PARALLAX_DEG = 5;
const OVERLAP_WEIGHT = 2;
const MIN_OVERLAP = 1e-3;
const GRID = 6; // points per side at which overlap and parallax are evaluated
const MIN_EXPLAINED_VARIANCE = 0.5;
const DEFAULT_DEPTH = 3; // in longest baselines
const SAMPLED_IMAGES = 3; // that are matched, with two others each

/**
 * The indices of the two views to use.
 * @param {import("./cameras.js").Camera[]} cameras
 * @param {(index: number) => Promise<import("./views.js").FeatureImage>} featureImage
 */
export async function selectPair(cameras, featureImage) {
  if (cameras.length === 2) return [0, 1];
  const depth = await sceneDepth(cameras, featureImage);
  let best = { cost: Infinity, pair: [0, 0] };
  for (let i = 0; i < cameras.length; i++) {
    for (let j = i + 1; j < cameras.length; j++) {
      const cost = pairCost(cameras[i], cameras[j], depth);
      if (cost < best.cost) best = { cost, pair: [i, j] };
    }
  }
  if (best.cost === Infinity) {
    throw new InputError("no two cameras see the same from different places; add images that overlap");
  }
  return best.pair;
}

async function sceneDepth(cameras, featureImage) {
  const guess = fixationDepth(cameras);
  const depths = [];
  const last = cameras.length - 1;
  for (let k = 1; k <= SAMPLED_IMAGES; k++) {
    const i = roundHalfEven((k * last) / (SAMPLED_IMAGES + 1));
    const costs = cameras.map((other, j) => (j === i ? Infinity : pairCost(cameras[i], other, guess)));
    const best = costs.every((cost) => cost === Infinity) ? 0 : costs.indexOf(Math.min(...costs));
    for (const j of [best, Math.min(i + 1, last)]) {
      if (i === j) continue;
      const [first, second] = [await featureImage(i), await featureImage(j)];
      const pose = relativePose(cameras[i].pose, cameras[j].pose);
      const pairs = matchFeatures(first.all, second.all);
      const matches = alongEpipolarLines(pairs, first.all, second.all, first.camera.K, second.camera.K, pose);
      depths.push(...triangulatedDepths(matches, pose));
    }
  }
  if (depths.length < 2 * MIN_POINTS) return guess;
  return percentile(depths.sort((a, b) => a - b), 50);
}

/** |log2(parallax / ideal)| - weight * log2(overlap): 0 for an ideal pair, infinite without parallax. */
function pairCost(first, second, depth) {
  const [there, back] = [scoreOneWay(first, second, depth), scoreOneWay(second, first, depth)];
  if (there.overlap === 0 || back.overlap === 0) return Infinity;
  const parallax = (((there.angle + back.angle) / 2) * 180) / Math.PI;
  const overlap = Math.max(Math.min(there.overlap, back.overlap), MIN_OVERLAP);
  const cost = Math.abs(Math.log2(parallax / IDEAL_PARALLAX_DEG)) - OVERLAP_WEIGHT * Math.log2(overlap);
  return cost === Infinity ? cost : roundHalfEven(cost * 1e6) / 1e6;
}

/** Share of the points of one camera that the other sees, and the mean angle of the viewing rays to these. */
function scoreOneWay(from, to, depth) {
  const [fx, fy, cx, cy] = from.K;
  const [centre, other] = [positionOf(from.pose), positionOf(to.pose)];
  const toCamera = transpose3(rotationOf(to.pose));
  let [seen, angles] = [0, 0];
  for (let k = 0; k < GRID * GRID; k++) {
    const u = (((k % GRID) + 0.5) / GRID) * from.width;
    const v = ((Math.floor(k / GRID) + 0.5) / GRID) * from.height;
    const ray = rotate(rotationOf(from.pose), [((u - cx) / fx) * depth, ((v - cy) / fy) * depth, depth]);
    const point = ray.map((value, axis) => value + centre[axis]);
    const fromOther = subtract(point, other);
    const [x, y, z] = rotate(toCamera, fromOther);
    const [pu, pv] = [(to.K[0] * x) / z + to.K[2], (to.K[1] * y) / z + to.K[3]];
    if (z > 0 && pu >= 0 && pu <= to.width && pv >= 0 && pv <= to.height) {
      const chord = norm(subtract(unit(subtract(point, centre)), unit(fromOther)));
      seen += 1;
      angles += 2 * Math.asin(Math.min(chord / 2, 1));
    }
  }
  return { overlap: seen / (GRID * GRID), angle: angles / Math.max(seen, 1) };
}

function unit(vector) {
  const length = norm(vector);
  return vector.map((value) => value / length);
}

/** The depth at which points on the optical axes come closest to each other; else three times the longest baseline. */
function fixationDepth(cameras) {
  const centred = (vectors) => {
    const mean = [0, 1, 2].map((axis) => vectors.reduce((sum, v) => sum + v[axis], 0) / vectors.length);
    return vectors.map((vector) => subtract(vector, mean));
  };
  const positions = centred(cameras.map((camera) => positionOf(camera.pose)));
  const forward = centred(cameras.map(({ pose }) => [pose[2], pose[6], pose[10]]));
  const total = (a, b) => a.reduce((sum, vector, index) => sum + dot(vector, b[index]), 0);
  const [pf, pp, ff] = [total(positions, forward), total(positions, positions), total(forward, forward)];
  if (pf < 0 && pf ** 2 > MIN_EXPLAINED_VARIANCE * pp * ff) return -pf / ff;
  let longest = 0; // all distances of many cameras are too many arguments for Math.max
  for (const a of positions) {
    for (const b of positions) longest = Math.max(longest, norm(subtract(a, b)));
  }
  return DEFAULT_DEPTH * longest;
}
