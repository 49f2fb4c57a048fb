/**
 * Cameras of two images without any, as `idesplat cameras estimate` finds them: a pinhole camera each, the focal length
 * from EXIF data or given, the relative pose from matched features. The unit is the median depth.
 */

import { InputError } from "./errors.js";
import { decode } from "./image_files.js";
import { dot, invertRigid, makePose, percentile, positionOf, rotationOf } from "./linear.js";
import { matchFeatures, normalizedPoint } from "./matching.js";
import { estimateRelativePose, rotationAlone } from "./two_view.js";
import { FeatureImage } from "./views.js";

const FILM_DIAGONAL_MM = Math.hypot(36, 24); // what equivalent focal lengths are relative to
const WHOLE_IMAGE = [1, 1, 0.5, 0.5]; // normalised intrinsics that every feature is inside of
const MAX_EPIPOLAR_ERROR = 1.5; // pixels, of an inlier
const MIN_MATCHES = 40;
const MIN_INLIER_SHARE = 0.3;
const MAX_ROTATION_SHARE = 0.7; // more matches that a rotation explains mean that there is no baseline
const MIN_PARALLAX_DEG = 1.5; // with less, the direction of the translation is mostly noise
const IDEAL_PARALLAX_DEG = 5;
const MAX_PAIRS = 12; // that are compared, of more than two images

const IDENTITY = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];

/** @typedef {{ file: File, camera: import("./cameras.js").Camera, found: import("./sift.js").Features }} EstimatedView */

/**
 * Two of the images with their cameras and features, the pair of the best parallax.
 * @param {File[]} files @param {(number | null)[]} focals of each, equivalent to 35 mm film @param {string[]} notes
 * @param {(stage: string, share: number | null) => void} onProgress
 * @returns {Promise<EstimatedView[]>}
 */
export async function estimateCameras(files, focals, onProgress, notes) {
  const loaded = new Map();
  const view = async (index) => {
    if (!loaded.has(index)) loaded.set(index, await features(files[index], focals[index]));
    return loaded.get(index);
  };
  const pairs = candidatePairs(files.length);
  let [best, problem] = [null, null];
  for (const [number, [first, second]] of pairs.entries()) {
    onProgress("estimating the cameras", number / pairs.length);
    try {
      const geometry = relate(await view(first), await view(second));
      const cost = Math.abs(Math.log2(geometry.parallax / IDEAL_PARALLAX_DEG)) - 2 * Math.log2(geometry.share);
      if (best === null || cost < best.cost) best = { cost, geometry, views: [await view(first), await view(second)] };
    } catch (error) {
      if (!(error instanceof InputError)) throw error;
      problem ??= error;
    }
  }
  if (best === null) throw problem;
  notes.push("the cameras were estimated from the images; the first is the world frame, and the unit is the median depth");
  const poses = scaledPoses(best.geometry);
  if (files.length > 2) notes.push(`2 of ${files.length} images used: ${best.views.map(({ file }) => file.name).join(", ")}`);
  return best.views.map(({ file, image, found }, index) => ({ file, found, camera: { ...image.pinhole, pose: poses[index] } }));
}

/** Images next to each other in the given order, and those with one between. */
function candidatePairs(count) {
  const pairs = [];
  for (let i = 0; i + 1 < count; i++) {
    pairs.push([i, i + 1]);
    if (i + 2 < count) pairs.push([i, i + 2]);
  }
  const step = Math.max(1, pairs.length / MAX_PAIRS);
  return Array.from({ length: Math.min(pairs.length, MAX_PAIRS) }, (_, index) => pairs[Math.floor(index * step)]);
}

/** An image's camera at the origin, and its features. */
async function features(file, focal) {
  const image = await decode(file);
  if (focal === null) {
    throw new InputError(`${file.name}: its EXIF data has no focal length; give it, equivalent to 35 mm film, or add cameras`);
  }
  const pixels = (focal / FILM_DIAGONAL_MM) * Math.hypot(image.width, image.height);
  const K = [pixels, pixels, image.width / 2, image.height / 2];
  const { width, height } = image;
  const pinhole = { name: file.name, width, height, K, pose: IDENTITY, distortion: null, fisheye: false };
  const small = new FeatureImage(image, /** @type {any} */ (pinhole), WHOLE_IMAGE);
  return { file, image: { pinhole, K: small.camera.K }, found: small.all };
}

/** The relative pose of two views. Throws InputError where the images do not tell it. */
function relate(first, second) {
  const pair = `${first.file.name} and ${second.file.name}`;
  const matches = matchFeatures(first.found, second.found).map(([i, j]) => [
    normalizedPoint(first.found, i, first.image.K),
    normalizedPoint(second.found, j, second.image.K),
  ]);
  if (matches.length < MIN_MATCHES) {
    throw new InputError(
      `${pair}: ${matches.length} features match, expected ${MIN_MATCHES} at least; give sharp images with texture ` +
        "that overlap more, or add cameras",
    );
  }
  const tolerance = MAX_EPIPOLAR_ERROR / Math.sqrt(first.image.K[0] * second.image.K[0]);
  if (rotationAlone(matches, tolerance).share > MAX_ROTATION_SHARE) throw samePlace(pair, 0);
  const geometry = estimateRelativePose(matches, tolerance);
  const least = Math.max(MIN_MATCHES, Math.round(matches.length * MIN_INLIER_SHARE));
  if (geometry.points.length < least) {
    throw new InputError(
      `${pair}: ${geometry.points.length} of ${matches.length} matches are inliers of a static scene, expected ${least} ` +
        "at least; check the focal length, or give other images",
    );
  }
  if (geometry.parallax < MIN_PARALLAX_DEG) throw samePlace(pair, geometry.parallax);
  return { ...geometry, share: geometry.points.length / matches.length };
}

function samePlace(pair, parallax) {
  return new InputError(
    `${pair}: were taken from nearly the same place: the parallax is ${parallax.toPrecision(2)} degrees, expected ` +
      `${MIN_PARALLAX_DEG} at least; step aside by a twentieth of the distance to the scene`,
  );
}

/** Poses camera-to-world, the first at the origin, in the unit of the median depth. */
function scaledPoses({ pose, points }) {
  const depths = points.flatMap((point) => [point[2], dot(pose.slice(8, 11), point) + pose[11]]).sort((a, b) => a - b);
  const unit = percentile(depths, 50);
  const second = invertRigid(pose);
  return [IDENTITY, makePose(rotationOf(second), positionOf(second).map((value) => value / unit))];
}
