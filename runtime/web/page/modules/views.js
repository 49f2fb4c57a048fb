/** Views: images undistorted and brought to the network's size, with a copy for features. */

import { resizeCamera, undistort } from "./cameras.js";
import { roundHalfEven } from "./linear.js";
import { matchFeatures } from "./matching.js";
import { resizeArea, resizeCubic, toGrey } from "./resampling.js";
import { extractFeatures } from "./sift.js";

const MAX_STRETCH = 1.15; // of one axis against the other, rather than a crop
const FEATURE_SIDE = 640;
const MAX_FEATURES = 4000;

/**
 * One view. image: RGB in [0, 1], three planes. intrinsics: fx, fy, cx, cy divided by width and height. share: of the
 * image that the network sees.
 * @typedef {object} View
 * @property {string} name
 * @property {Float32Array} image
 * @property {number[]} intrinsics
 * @property {import("./cameras.js").Camera} camera
 * @property {FeatureImage} features
 * @property {number} share
 */

/** A small undistorted copy of an image, with its features, found when first asked for. */
export class FeatureImage {
  /** @param {import("./resampling.js").Image} image @param {number[]} crop normalised intrinsics of what is seen */
  constructor(image, camera, crop) {
    const factor = Math.min(1, FEATURE_SIDE / Math.max(image.width, image.height));
    const width = Math.max(1, roundHalfEven(camera.width * factor));
    const height = Math.max(1, roundHalfEven(camera.height * factor));
    const small = undistort(resizeArea(image, width, height), resizeCamera(camera, width, height));
    this.camera = small.camera;
    this.crop = crop;
    this.grey = toGrey(small.image);
    this.found = null;
  }

  /** All features. @returns {import("./sift.js").Features} */
  get all() {
    this.found ??= extractFeatures(this.grey.data, this.grey.width, this.grey.height, MAX_FEATURES);
    return this.found;
  }

  /** The features inside the part that the network sees. @returns {import("./sift.js").Features} */
  get inside() {
    const { all, crop } = this;
    const [fx, fy, cx, cy] = this.camera.K;
    const kept = [];
    for (let i = 0; i < all.count; i++) {
      const u = ((all.keypoints[2 * i] - cx) / fx) * crop[0] + crop[2];
      const v = ((all.keypoints[2 * i + 1] - cy) / fy) * crop[1] + crop[3];
      if (u >= 0 && u <= 1 && v >= 0 && v <= 1) kept.push(i);
    }
    return {
      count: kept.length,
      keypoints: Float64Array.from(kept.flatMap((i) => [all.keypoints[2 * i], all.keypoints[2 * i + 1]])),
      descriptors: pick(all.descriptors, kept),
    };
  }
}

function pick(descriptors, kept) {
  const picked = new Float32Array(128 * kept.length);
  kept.forEach((from, to) => picked.set(descriptors.subarray(128 * from, 128 * (from + 1)), 128 * to));
  return picked;
}

/** Matches of the features that the network sees of two views. @param {View} first @param {View} second */
export function matchViews(first, second) {
  const [a, b] = [first.features.inside, second.features.inside];
  return { pairs: matchFeatures(a, b), first: a, second: b };
}

/** @param {import("./resampling.js").Image} image @param {import("./cameras.js").Camera} given @returns {View} */
export function makeView(image, given, height, width) {
  const camera = resizeCamera(given, image.width, image.height);
  const plain = undistort(image, camera);
  const crop = frameCrop(image.width, image.height, width, height);
  const resize = crop.scaleX < 1 ? resizeArea : resizeCubic;
  const scaled = resize(plain.image, crop.width, crop.height);
  const [fx, fy, cx, cy] = plain.camera.K;
  const intrinsics = [
    (fx * crop.scaleX) / width,
    (fy * crop.scaleY) / height,
    (cx * crop.scaleX - crop.left) / width,
    (cy * crop.scaleY - crop.top) / height,
  ].map(Math.fround);
  return {
    name: given.name,
    image: planes(scaled, crop, height, width),
    intrinsics,
    camera: plain.camera,
    features: new FeatureImage(image, camera, intrinsics),
    share: (width * height) / (crop.width * crop.height),
  };
}

/** The whole image where its shape is nearly the target's; else the smallest size that covers it, and its middle. */
function frameCrop(width, height, targetWidth, targetHeight) {
  const [scaleX, scaleY] = [targetWidth / width, targetHeight / height];
  if (Math.max(scaleX, scaleY) <= MAX_STRETCH * Math.min(scaleX, scaleY)) {
    return { scaleX, scaleY, width: targetWidth, height: targetHeight, left: 0, top: 0 };
  }
  const factor = Math.max(scaleX, scaleY);
  const scaledWidth = Math.max(targetWidth, roundHalfEven(width * factor));
  const scaledHeight = Math.max(targetHeight, roundHalfEven(height * factor));
  return {
    scaleX: scaledWidth / width,
    scaleY: scaledHeight / height,
    width: scaledWidth,
    height: scaledHeight,
    left: Math.floor((scaledWidth - targetWidth) / 2),
    top: Math.floor((scaledHeight - targetHeight) / 2),
  };
}

function planes(image, crop, height, width) {
  const out = new Float32Array(3 * height * width);
  for (let c = 0; c < 3; c++) {
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) {
        const from = ((y + crop.top) * image.width + x + crop.left) * 3 + c;
        out[(c * height + y) * width + x] = image.data[from] / 255;
      }
    }
  }
  return out;
}
