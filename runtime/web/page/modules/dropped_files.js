/** Files that were dropped or chosen: images, and cameras. */

import { InputError } from "./errors.js";

const IMAGE_NAME = /\.(jpe?g|png|webp|avif|bmp|gif|heic|heif)$/i;
const MAX_JSON_BYTES = 64e6;

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
  const images = files.filter((file) => file.type.startsWith("image/") || IMAGE_NAME.test(file.name));
  const cameraFiles = files.filter((file) => !images.includes(file) && /\.json$/i.test(file.name));
  const others = files.filter((file) => !images.includes(file) && !cameraFiles.includes(file));
  return { images, cameraFiles, others };
}

/** The document of the camera file; null without one. @param {File[]} cameraFiles */
export async function readCameraFile(cameraFiles) {
  const named = cameraFiles.find((file) => file.name === "transforms.json") ?? cameraFiles[0];
  if (!named) return null;
  if (named.size > MAX_JSON_BYTES) throw new InputError(`${named.name}: has ${named.size} bytes, expected a transforms.json`);
  try {
    return JSON.parse(await named.text());
  } catch (error) {
    throw new InputError(`${named.name}: is no JSON (${/** @type {Error} */ (error).message}); save it again`);
  }
}
