/** Cameras: what one is, transforms.json, resizing and lens distortion. */

import { InputError } from "./errors.js";
import { makePose, nearestRotation, positionOf, rotationOf, transpose3, multiply } from "./linear.js";
import { remap } from "./resampling.js";

/**
 * The camera of one image. K: fx, fy, cx, cy in pixels, pixel centres at 0.5. pose: camera-to-world, OpenCV axes, 16
 * numbers. distortion: OpenCV's k1 k2 p1 p2 k3, or k1 to k4 of a fisheye lens; null without.
 * @typedef {object} Camera
 * @property {string} name
 * @property {number} width
 * @property {number} height
 * @property {[number, number, number, number]} K
 * @property {number[]} pose
 * @property {number[] | null} distortion
 * @property {boolean} fisheye
 */

const PERSPECTIVE_MODELS = ["OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL"];
const FISHEYE_MODEL = "OPENCV_FISHEYE";
const PERSPECTIVE_FIELDS = ["k1", "k2", "p1", "p2", "k3"]; // in OpenCV's order
const FISHEYE_FIELDS = ["k1", "k2", "k3", "k4"];
const DISTORTION_FIELDS = ["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"];
const MIN_FIELD_OF_VIEW = 0.001; // radians
const MAX_ROTATION_ERROR = 1e-3;
const IMAGE_SUFFIX = /(?<=.)\.(jpe?g|jpe|jfif|png|webp|tiff?|bmp|jp2|avif|ppm|pgm|hei[cf]|hif)$/i;

/**
 * The cameras of a parsed transforms.json (nerfstudio, instant-ngp).
 * @param {any} document @param {{ name: string, width: number, height: number }[]} images for sizes that it lacks
 * @returns {Camera[]}
 */
export function parseTransforms(document, images) {
  if (!document || !Array.isArray(document.frames) || document.frames.length === 0) {
    throw new InputError("transforms.json: has no frames, expected a list `frames` with `transform_matrix`");
  }
  return document.frames.map((frame, index) => {
    const name = frame?.file_path;
    if (typeof name !== "string") throw new InputError(`transforms.json: frames[${index}] has no file_path`);
    return parseFrame({ ...document, ...frame }, name, images);
  });
}

function parseFrame(fields, name, images) {
  const where = `transforms.json: ${name}`;
  const number = (field) => {
    const value = fields[field];
    if (typeof value !== "number" || !Number.isFinite(value)) {
      throw new InputError(`${where}: ${field} is ${JSON.stringify(value)}, expected a number`);
    }
    return value;
  };
  const optional = (field, value) => (field in fields ? number(field) : value);
  const image = images.find((candidate) => stem(candidate.name) === stem(name)) ?? images[0];
  const width = optional("w", image?.width);
  const height = optional("h", image?.height);
  if (!(width > 0 && height > 0)) throw new InputError(`${where}: w and h are missing; add them`);
  const fisheye = isFisheye(fields, where);
  const K = intrinsics(fields, width, height, number, where);
  const distortion = distortionOf(fisheye, optional, where);
  return { name, width, height, K, pose: openglPose(fields.transform_matrix, where), distortion, fisheye };
}

function isFisheye(fields, where) {
  const models = [...PERSPECTIVE_MODELS, FISHEYE_MODEL];
  const { camera_model: model = "OPENCV", is_fisheye: flag = false } = fields;
  if (!models.includes(model)) {
    const expected = `expected one of ${models.join(", ")}`;
    throw new InputError(`${where}: camera_model is ${JSON.stringify(model)}, ${expected}; undistort the images first`);
  }
  if (typeof flag !== "boolean") {
    throw new InputError(`${where}: is_fisheye is ${JSON.stringify(flag)}, expected true or false`);
  }
  if ("distortion_params" in fields) {
    const advice = "write k1, k2, p1, p2, or undistort the images first";
    throw new InputError(`${where}: distortion_params is not read; ${advice}`);
  }
  return flag || model === FISHEYE_MODEL;
}

/** The coefficients of the lens; null for a pinhole. */
function distortionOf(fisheye, optional, where) {
  const names = fisheye ? FISHEYE_FIELDS : PERSPECTIVE_FIELDS;
  for (const field of DISTORTION_FIELDS.filter((name) => !names.includes(name))) {
    const value = optional(field, 0);
    if (value !== 0) {
      const expected = `only ${names.join(", ")} for a ${fisheye ? "fisheye" : "perspective"} lens`;
      throw new InputError(`${where}: ${field} is ${value}, expected ${expected}; undistort the images first`);
    }
  }
  const values = names.map((field) => optional(field, 0));
  return fisheye || values.some((value) => value !== 0) ? values : null; // a fisheye lens without is no pinhole either
}

function intrinsics(fields, width, height, number, where) {
  const focal = (field, side) => {
    const angle = number(field);
    if (!(MIN_FIELD_OF_VIEW < angle && angle < Math.PI)) {
      throw new InputError(`${where}: ${field} is ${angle}, expected radians between ${MIN_FIELD_OF_VIEW} and pi`);
    }
    return (0.5 * side) / Math.tan(0.5 * angle);
  };
  if (!("fl_x" in fields) && !("camera_angle_x" in fields)) {
    throw new InputError(`${where}: fl_x is missing, and camera_angle_x too; expected one of them`);
  }
  const fx = "fl_x" in fields ? number("fl_x") : focal("camera_angle_x", width);
  let fy = fx;
  if ("fl_y" in fields) fy = number("fl_y");
  else if (!("fl_x" in fields) && "camera_angle_y" in fields) fy = focal("camera_angle_y", height);
  const cx = "cx" in fields ? number("cx") : width / 2;
  const cy = "cy" in fields ? number("cy") : height / 2;
  if (!(fx > 0 && fy > 0)) throw new InputError(`${where}: the focal lengths are ${fx} and ${fy}, expected positive`);
  return [fx, fy, cx, cy];
}

/** A pose with OpenGL axes (y up, z backward) to one with OpenCV's. */
function openglPose(matrix, where) {
  const rows = Array.isArray(matrix) ? matrix.flat() : [];
  if (rows.length < 12 || !rows.every(Number.isFinite)) {
    throw new InputError(`${where}: transform_matrix is no 4x4 matrix of numbers`);
  }
  const pose = rows.slice(0, 12).map((value, index) => ([1, 2].includes(index % 4) ? -value : value));
  return rigid([...pose, 0, 0, 0, 1], where);
}

/** The pose with an exact rotation. @param {number[]} pose @param {string} where */
export function rigid(pose, where) {
  const rotation = rotationOf(pose);
  const product = multiply(transpose3(rotation), rotation, 3);
  const error = Math.max(...product.map((value, index) => Math.abs(value - (index % 4 === 0 ? 1 : 0))));
  if (!(error < MAX_ROTATION_ERROR)) {
    throw new InputError(`${where}: the pose is not a rotation and a translation (off by ${error.toPrecision(2)})`);
  }
  return makePose(nearestRotation(rotation), positionOf(pose));
}

/** File name without folders, which files written on Windows separate by backslashes. @param {string} path */
export function fileName(path) {
  return path.replaceAll("\\", "/").split("/").pop() ?? "";
}

/** File name without folders and the suffix of an image; other suffixes, as in r_0.5, are kept. @param {string} path */
export function stem(path) {
  return fileName(path).replace(IMAGE_SUFFIX, "");
}

/** The camera of the same image at another size. @param {Camera} camera */
export function resizeCamera(camera, width, height) {
  if (camera.width === width && camera.height === height) return camera;
  const least = Math.max((width - 1) / camera.width, (height - 1) / camera.height);
  const largest = Math.min((width + 1) / camera.width, (height + 1) / camera.height);
  if (least > largest) {
    throw new InputError(
      `${camera.name}: the image has ${width} x ${height} pixels, its camera ${camera.width} x ${camera.height}; ` +
        "give the images that the cameras were made for",
    );
  }
  const [sx, sy] = [width / camera.width, height / camera.height];
  const [fx, fy, cx, cy] = camera.K;
  return { ...camera, width, height, K: /** @type {any} */ ([fx * sx, fy * sy, cx * sx, cy * sy]) };
}

/** An image without lens distortion, and its camera. @param {import("./resampling.js").Image} image @param {Camera} camera */
export function undistort(image, camera) {
  if (camera.distortion === null) return { image, camera };
  const [fx, fy] = camera.K;
  const [cx, cy] = [camera.K[2] - 0.5, camera.K[3] - 0.5]; // OpenCV's pixel centres are at whole numbers
  const bend = camera.fisheye ? fisheyeLens(camera.distortion) : perspectiveLens(camera.distortion);
  /** @type {(x: number, y: number) => [number, number]} */
  const source = (x, y) => {
    const [u, v] = bend((x - cx) / fx, (y - cy) / fy);
    return [u * fx + cx, v * fy + cy];
  };
  return { image: remap(image, source), camera: { ...camera, distortion: null, fisheye: false } };
}

/** @param {number[]} distortion */
function perspectiveLens([k1, k2, p1, p2, k3 = 0]) {
  return (x, y) => {
    const r2 = x * x + y * y;
    const radial = 1 + ((k3 * r2 + k2) * r2 + k1) * r2;
    return [x * radial + p1 * 2 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + p2 * 2 * x * y];
  };
}

/** @param {number[]} distortion */
function fisheyeLens([k1, k2, k3, k4]) {
  return (x, y) => {
    const r = Math.hypot(x, y);
    const theta = Math.atan(r);
    const t2 = theta * theta;
    const bent = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))));
    const scale = r === 0 ? 1 : bent / r;
    return [x * scale, y * scale];
  };
}
