/** Files that were dropped or chosen: images, and cameras. */

import { parseColmap } from "./colmap.js";
import { InputError } from "./errors.js";

const CAMERA_NAME = /(\.json|^cameras\.txt|^images\.txt|^cameras\.bin|^images\.bin)$/i;
const BESIDE_CAMERAS = /^(points3D|frames|rigs)\.(txt|bin)$/i; // COLMAP's further files, which are not needed
const IMAGE_NAME = /\.(jpe?g|png|webp|avif|bmp|gif|heic|heif)$/i;
const MAX_BYTES = 512e6; // of a file with cameras

/** All files of a drop, also those in folders. @param {DataTransfer} transfer @returns {Promise<File[]>} */
export async function filesOfDrop(transfer) {
  const entries = [...transfer.items].map((item) => item.webkitGetAsEntry?.()).filter((entry) => entry !== null);
  if (entries.length === 0) return [...transfer.files];
  const files = await Promise.all(entries.map((entry) => filesOfEntry(entry)));
  return files.flat();
}

async function filesOfEntry(entry) {
  if (entry.isFile) return [await new Promise((resolve, reject) => entry.file(resolve, reject))];
  const reader = entry.createReader();
  const files = [];
  for (;;) {
    const part = await new Promise((resolve, reject) => reader.readEntries(resolve, reject));
    if (part.length === 0) return files;
    for (const child of part) files.push(...(await filesOfEntry(child)));
  }
}

/** @param {File[]} files @returns {{ images: File[], cameraFiles: File[], others: File[] }} */
export function sortFiles(files) {
  const wanted = files.filter((file) => !BESIDE_CAMERAS.test(file.name));
  const images = wanted.filter((file) => file.type.startsWith("image/") || IMAGE_NAME.test(file.name));
  const cameraFiles = wanted.filter((file) => !images.includes(file) && CAMERA_NAME.test(file.name));
  const others = wanted.filter((file) => !images.includes(file) && !cameraFiles.includes(file));
  return { images, cameraFiles, others };
}

/** The cameras of a parsed transforms.json or of COLMAP's text model; null without files. @param {File[]} cameraFiles */
export async function readCameraFiles(cameraFiles) {
  const named = (name) => cameraFiles.find((file) => file.name.toLowerCase() === name);
  const document = named("transforms.json") ?? cameraFiles.find((file) => /\.json$/i.test(file.name));
  if (document) return readDocument(document);
  const [cameras, images] = [named("cameras.txt"), named("images.txt")];
  if (cameras && images) return parseColmap(await readText(cameras), await readText(images));
  if (cameras || images) throw new InputError(`${(cameras ?? images)?.name}: add ${cameras ? "images.txt" : "cameras.txt"}, too`);
  if (cameraFiles.length === 0) return null;
  const convert = "colmap model_converter --output_type TXT";
  throw new InputError(`${cameraFiles[0].name}: is COLMAP's binary model, expected the text model; ${convert} writes it`);
}

async function readDocument(file) {
  const text = await readText(file);
  let document;
  try {
    document = JSON.parse(text);
  } catch (error) {
    throw new InputError(`${file.name}: is no JSON (${/** @type {Error} */ (error).message}); save it again`);
  }
  if (!Array.isArray(document?.frames)) { // also null, which would mean that cameras are estimated
    const advice = "`idesplat cameras convert` makes one of other formats";
    throw new InputError(`${file.name}: has no list of frames, expected a transforms.json; ${advice}`);
  }
  return document;
}

async function readText(file) {
  if (file.size > MAX_BYTES) throw new InputError(`${file.name}: has ${file.size} bytes, expected a file with cameras`);
  return file.text();
}
