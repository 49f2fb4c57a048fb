/** Near and far of two views: from triangulated matches, or else from the baseline. */

import { norm, percentile, positionOf, subtract } from "./linear.js";
import { triangulatedDepths } from "./matching.js";

export const MIN_POINTS = 20;
const [NEAR_PERCENTILE, FAR_PERCENTILE] = [2, 98]; // against outliers
const [NEAR_FACTOR, FAR_FACTOR] = [0.5, 1.5]; // surfaces without points may lie outside the range of the points

/**
 * @param {number[][][]} matches that fit the cameras @param {number[]} pose of the first camera in the second's frame
 * @param {number[][]} poses of both @param {{ near: number, far: number }} trained
 */
export function depthRange(matches, pose, poses, trained) {
  const depths = triangulatedDepths(matches, pose).filter((depth) => Number.isFinite(depth) && depth > 0);
  if (depths.length >= MIN_POINTS) {
    depths.sort((a, b) => a - b);
    return {
      near: NEAR_FACTOR * percentile(depths, NEAR_PERCENTILE),
      far: FAR_FACTOR * percentile(depths, FAR_PERCENTILE),
      source: `${depths.length / 2} points matched between the images`,
    };
  }
  const baseline = norm(subtract(positionOf(poses[0]), positionOf(poses[1])));
  return { near: baseline, far: (baseline * trained.far) / trained.near, source: "the baseline" };
}
