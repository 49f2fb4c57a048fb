/** COLMAP's text model: cameras.txt and images.txt. */

import { rigid } from "./cameras.js";
import { InputError } from "./errors.js";
import { invertRigid, makePose, norm } from "./linear.js";

// Parameters of each camera model by name, in COLMAP's order; f stands for fx and fy.
const MODELS = {
  SIMPLE_PINHOLE: ["f", "cx", "cy"],
  PINHOLE: ["fx", "fy", "cx", "cy"],
  SIMPLE_RADIAL: ["f", "cx", "cy", "k1"],
  RADIAL: ["f", "cx", "cy", "k1", "k2"],
  OPENCV: ["fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"],
  SIMPLE_RADIAL_FISHEYE: ["f", "cx", "cy", "k1"],
  RADIAL_FISHEYE: ["f", "cx", "cy", "k1", "k2"],
  OPENCV_FISHEYE: ["fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"],
};
const FISHEYE = "FISHEYE"; // the end of their names
const MIN_NORM = 1e-6; // of a quaternion

/**
 * The cameras of a text model.
 * @param {string} camerasText of cameras.txt @param {string} imagesText of images.txt
 * @returns {import("./cameras.js").Camera[]}
 */
export function parseColmap(camerasText, imagesText) {
  const lenses = new Map(lines(camerasText).filter((line) => line.trim() !== "").map(parseLens));
  const rows = lines(imagesText);
  while (rows.length > 0 && rows[rows.length - 1].trim() === "") rows.pop();
  const poses = rows.filter((_, index) => index % 2 === 0); // each is followed by the points of the image
  if (poses.length === 0) throw new InputError("images.txt: names no images; export the model again");
  return poses.map((line) => parseImage(line, lenses));
}

function lines(text) {
  return text.split(/\r?\n/).filter((line) => !line.startsWith("#"));
}

function parseLens(line) {
  const [id, model, ...texts] = line.trim().split(/\s+/);
  const names = MODELS[model];
  if (names === undefined) {
    throw new InputError(`cameras.txt: camera ${id} has the model ${model}, expected ${Object.keys(MODELS).join(", ")}`);
  }
  const [width, height, ...values] = texts.map(Number);
  const lens = Object.fromEntries(names.map((name, index) => [name, values[index]]));
  const { f, fx = f, fy = f, cx, cy } = lens;
  if (values.length !== names.length || ![width, height, fx, fy].every((value) => value > 0) || !values.every(Number.isFinite)) {
    throw new InputError(`cameras.txt: "${line.trim()}": expected a width, a height and ${names.join(" ")}`);
  }
  const fisheye = model.endsWith(FISHEYE);
  const distortion = (fisheye ? ["k1", "k2", "k3", "k4"] : ["k1", "k2", "p1", "p2", "k3"]).map((name) => lens[name] ?? 0);
  const bends = fisheye || distortion.some((value) => value !== 0);
  return [id, { width, height, K: [fx, fy, cx, cy], distortion: bends ? distortion : null, fisheye }];
}

function parseImage(line, lenses) {
  const [, ...words] = line.trim().split(/\s+/);
  const [w, x, y, z, ...translation] = words.slice(0, 7).map(Number);
  const [camera, name] = [words[7], words.slice(8).join(" ")];
  const length = norm([w, x, y, z]);
  if (name === "" || translation.length !== 3 || !translation.every(Number.isFinite) || !(length > MIN_NORM)) {
    throw new InputError(`images.txt: "${line.trim()}": expected id, quaternion, translation, camera and name`);
  }
  if (!lenses.has(camera)) throw new InputError(`images.txt: ${name}: camera ${camera} is not in cameras.txt`);
  const toCamera = makePose(rotationMatrix([w, x, y, z].map((value) => value / length)), translation);
  return { name, ...lenses.get(camera), pose: invertRigid(rigid(toCamera, `images.txt: ${name}`)) };
}

/** @param {number[]} quat */
function rotationMatrix([w, x, y, z]) {
  return [
    ...[1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
    ...[2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
    ...[2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
  ];
}
