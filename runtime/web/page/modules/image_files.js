/** Image files: what their headers say, and their pixels. */

import { InputError } from "./errors.js";

const MAX_SIDE = 16384; // pixels: browsers draw nothing larger
const MAX_PIXELS = 100e6;
const HEADER_BYTES = 1 << 18;
const ORIENTATION = 0x0112;
const EXIF_DIRECTORY = 0x8769;
const FOCAL_LENGTH_35MM = 0xa405;
const SHORT = 3;
const ENTRY_BYTES = 12;

/**
 * width, height: as stored, before the EXIF rotation; 0 if the format is not known here. focal: equivalent to 35 mm film,
 * in mm; null if the image does not tell.
 * @typedef {{ width: number, height: number, orientation: number, focal: number | null }} Header
 */

const UNKNOWN = { width: 0, height: 0, orientation: 1, focal: null };

/** Read and check the header of an image. @param {File} file @returns {Promise<Header>} */
export async function readHeader(file) {
  if (file.size === 0) throw new InputError(`${file.name}: is empty, expected an image; copy it again`);
  const bytes = new DataView(await file.slice(0, HEADER_BYTES).arrayBuffer());
  const header = pngHeader(bytes) ?? jpegHeader(bytes) ?? UNKNOWN;
  if (Math.max(header.width, header.height) > MAX_SIDE || header.width * header.height > MAX_PIXELS) {
    throw new InputError(
      `${file.name}: has ${header.width} x ${header.height} pixels, expected at most ${MAX_SIDE} a side and ` +
        `${MAX_PIXELS / 1e6} million in all; save it smaller`,
    );
  }
  return header;
}

function pngHeader(bytes) {
  if (bytes.byteLength < 24 || bytes.getUint32(0) !== 0x89504e47) return null;
  return { ...UNKNOWN, width: bytes.getUint32(16), height: bytes.getUint32(20) };
}

function jpegHeader(bytes) {
  if (bytes.byteLength < 4 || bytes.getUint16(0) !== 0xffd8) return null;
  const found = { ...UNKNOWN };
  for (let at = 2; at + 10 <= bytes.byteLength; ) {
    const marker = bytes.getUint16(at);
    if (marker === 0xffe1 && bytes.getUint32(at + 4) === 0x45786966) Object.assign(found, exif(bytes, at + 10));
    if (marker >= 0xffc0 && marker <= 0xffcf && ![0xffc4, 0xffc8, 0xffcc].includes(marker)) {
      return { ...found, height: bytes.getUint16(at + 5), width: bytes.getUint16(at + 7) };
    }
    at += 2 + bytes.getUint16(at + 2);
  }
  return found;
}

/** Orientation and focal length of the EXIF block that starts at `start`. */
function exif(bytes, start) {
  const found = {};
  try {
    const little = bytes.getUint16(start) === 0x4949;
    const main = directory(bytes, start, bytes.getUint32(start + 4, little), little);
    if (main.has(ORIENTATION)) found.orientation = main.get(ORIENTATION);
    const details = main.has(EXIF_DIRECTORY) ? directory(bytes, start, main.get(EXIF_DIRECTORY), little) : new Map();
    const focal = details.get(FOCAL_LENGTH_35MM) ?? 0;
    if (focal > 0) found.focal = focal;
  } catch (error) {
    if (!(error instanceof RangeError)) throw error; // a damaged block says nothing
  }
  return found;
}

/** The whole numbers of a directory of a TIFF structure, by tag. */
function directory(bytes, start, offset, little) {
  const first = start + offset;
  const count = bytes.getUint16(first, little);
  const values = new Map();
  for (let k = 0, entry = first + 2; k < count; k++, entry += ENTRY_BYTES) {
    const short = bytes.getUint16(entry + 2, little) === SHORT;
    values.set(bytes.getUint16(entry, little), short ? bytes.getUint16(entry + 8, little) : bytes.getUint32(entry + 8, little));
  }
  return values;
}

/** Pixels of an image, upright, RGB, transparency over white. @param {File} file */
export async function decode(file) {
  let bitmap;
  try {
    const options = { colorSpaceConversion: "none", imageOrientation: "from-image" };
    bitmap = await createImageBitmap(file, /** @type {ImageBitmapOptions} */ (options));
  } catch {
    throw new InputError(`${file.name}: is no image that this browser reads; save it as JPEG or PNG`);
  }
  const { width, height } = bitmap;
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  if (!context) throw new InputError(`${file.name}: there is no memory for ${width} x ${height} pixels; save it smaller`);
  context.fillStyle = "white";
  context.fillRect(0, 0, width, height);
  context.drawImage(bitmap, 0, 0);
  bitmap.close();
  const rgba = context.getImageData(0, 0, width, height).data;
  const data = new Uint8Array(3 * width * height);
  for (let from = 0, to = 0; to < data.length; from += 4, to += 3) {
    data[to] = rgba[from];
    data[to + 1] = rgba[from + 1];
    data[to + 2] = rgba[from + 2];
  }
  return { data, width, height, channels: 3 };
}
