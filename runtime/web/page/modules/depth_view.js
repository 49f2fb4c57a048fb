/** Depth maps as images: inverse depth in colours, near warm and far cold. */

const PERCENTILES = [2, 98]; // of inverse depth, at the ends of the colours
// Colours from far to near, RGB, evenly spaced.
const COLOURS = [[35, 23, 80], [44, 94, 170], [42, 163, 160], [150, 203, 92], [249, 208, 64], [240, 110, 40], [150, 20, 20]];

/** A canvas for one view. @param {import("../idesplat.d.ts").Depth} depth @param {number} view */
export function depthCanvas(depth, view) {
  const { height, width } = depth;
  const inverse = depth.data.slice(view * height * width, (view + 1) * height * width).map((value) => 1 / value);
  const sorted = inverse.slice().sort();
  const [low, high] = PERCENTILES.map((percent) => sorted[Math.floor(((sorted.length - 1) * percent) / 100)]);
  const canvas = document.createElement("canvas");
  Object.assign(canvas, { width, height });
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  const pixels = context.createImageData(width, height);
  inverse.forEach((value, index) => {
    const [red, green, blue] = colour((value - low) / (high - low || 1));
    pixels.data.set([red, green, blue, 255], 4 * index);
  });
  context.putImageData(pixels, 0, 0);
  return canvas;
}

function colour(share) {
  const position = Math.min(Math.max(share, 0), 1) * (COLOURS.length - 1);
  const below = Math.min(Math.floor(position), COLOURS.length - 2);
  return COLOURS[below].map((value, c) => value + (position - below) * (COLOURS[below + 1][c] - value));
}

/** Median depth of the first view, for the distance around which a viewer turns. */
export function medianDepth(depth) {
  const first = depth.data.slice(0, depth.height * depth.width).sort();
  return first[first.length >> 1];
}
