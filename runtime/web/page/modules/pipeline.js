/** The whole flow: image files and cameras to depth and Gaussians. */

import { fileName, parseTransforms, stem } from "./cameras.js";
import { depthRange } from "./depth_range.js";
import { InputError } from "./errors.js";
import { estimateCameras } from "./estimation.js";
import { compensateExposure } from "./exposure.js";
import { decode, readHeader } from "./image_files.js";
import { norm, positionOf, subtract } from "./linear.js";
import { alongEpipolarLines, relativePose } from "./matching.js";
import { Network, readModel, wasmBytes } from "./network.js";
import { selectPair } from "./selection.js";
import { makeView, matchViews } from "./views.js";

const SAME_POSITION = 1e-9; // relative to the distance from the origin

/** @typedef {(stage: string, share: number | null) => void} OnProgress share: null where it is not known */

/**
 * @param {File[]} files @param {any} cameras a parsed transforms.json, a list of cameras, or null to estimate them
 * @param {{ provider?: import("./network.js").Provider | null, near?: number, far?: number, focal?: number }} options
 * @param {OnProgress} onProgress @param {URL} base folder of the page's files
 */
export async function run(files, cameras, options, onProgress, base) {
  const clock = stopwatch();
  const notes = [];
  onProgress("reading images", null);
  const model = await readModel(base);
  const pairs = await pairUp(files, cameras ?? null, options.focal ?? null, onProgress, notes);
  const views = await chosenViews(pairs, model, onProgress, notes);
  onProgress("finding near and far", null);
  const placed = compareViews(views, model, options, notes);
  clock.lap("prepare");
  const { result, network } = await predictOn(options.provider ?? null, base, model, views, placed, onProgress, notes, clock);
  const { provider, threads } = network;
  const memory = wasmBytes();
  await network.close();
  const poses = views.map(({ name, camera, intrinsics }) => ({ name, pose: camera.pose, intrinsics }));
  return { ...result, cameras: poses, near: placed.near, far: placed.far, provider, threads, memory, notes, seconds: clock.seconds };
}

/** The prediction and the network that made it: where WebGPU was not asked for and fails, on WebAssembly. */
async function predictOn(asked, base, model, views, placed, onProgress, notes, clock) {
  const show = (share) => onProgress("loading the model", share);
  const network = await Network.open(base, model, asked, show, (line) => notes.push(line));
  clock.lap("load");
  onProgress("predicting depth and Gaussians", null);
  try {
    const result = await predict(network, views, placed, model);
    clock.lap("predict");
    return { result, network };
  } catch (error) {
    if (asked !== null || network.provider !== "webgpu" || !(error instanceof InputError)) throw error;
    await network.close();
    notes.push(`${error.message.split(";")[0]}; WebAssembly is used instead`);
    return predictOn("wasm", base, model, views, placed, onProgress, notes, clock);
  }
}

function stopwatch() {
  const seconds = {};
  let last = performance.now();
  const lap = (name) => {
    seconds[name] = (performance.now() - last) / 1000;
    last = performance.now();
  };
  return { seconds, lap };
}

/** The images that have a camera, with it; two of them if the cameras are estimated. */
async function pairUp(files, cameras, focal, onProgress, notes) {
  if (files.length < 2) {
    const found = files.length === 1 ? "one image" : "no images";
    throw new InputError(`${found} given, expected at least two of the same scene; add images`);
  }
  const headers = await Promise.all(files.map(readHeader));
  if (cameras === null) return estimateCameras(files, headers.map((header) => header.focal ?? focal), onProgress, notes);
  const sizes = headers.map(({ width, height, orientation }, index) =>
    orientation > 4 ? { name: files[index].name, width: height, height: width } : { name: files[index].name, width, height },
  );
  const known = Array.isArray(cameras) ? checkedList(cameras) : parseTransforms(cameras, sizes);
  const pairs = matchFilesToCameras(files, known, notes);
  if (pairs.length < 2) {
    const names = known.slice(0, 3).map((camera) => camera.name).join(", ");
    throw new InputError(
      `${pairs.length} of ${files.length} images are named by the cameras (${names}, ...), expected at least two; ` +
        "add the images that the cameras were made for",
    );
  }
  return pairs;
}

/** A list of cameras, as `parseColmap` gives it; other lists, as 3DGS's cameras.json, are refused. */
function checkedList(cameras) {
  const known = (camera) => typeof camera?.name === "string" && Array.isArray(camera.K) && Array.isArray(camera.pose);
  const wrong = cameras.findIndex((camera) => !known(camera));
  if (wrong >= 0) {
    throw new InputError(`cameras[${wrong}]: expected a camera as parseColmap gives it; give a parsed transforms.json`);
  }
  return cameras;
}

/** Each image with the camera that names it, one with the same suffix first; images without a camera are left out. */
function matchFilesToCameras(files, cameras, notes) {
  const taken = new Map();
  for (const file of files) {
    const named = cameras.filter((camera) => stem(camera.name) === stem(file.name));
    const exact = named.filter((camera) => fileName(camera.name) === file.name);
    const [camera, ...others] = exact.length > 0 ? exact : named;
    if (!camera) {
      notes.push(`${file.name}: no camera names it; left out`);
      continue;
    }
    if (others.length > 0) {
      const names = [camera, others[0]].map(({ name }) => name).join(", ");
      const found = `${others.length + 1} cameras match it equally (${names})`;
      throw new InputError(`${file.name}: ${found}, expected one; give each image a name of its own`);
    }
    if (taken.has(camera)) {
      const names = `${taken.get(camera).name} and ${file.name}`;
      throw new InputError(`${names}: both match the camera of ${camera.name}, expected one; leave one out`);
    }
    taken.set(camera, file);
  }
  return [...taken].map(([camera, file]) => ({ file, camera }));
}

/** The two views to use, at the network's size. */
async function chosenViews(pairs, model, onProgress, notes) {
  const { height, width } = model;
  const loaded = new Map();
  const view = async (index) => {
    if (!loaded.has(index)) {
      onProgress(`reading ${pairs[index].file.name}`, null);
      const image = await decode(pairs[index].file);
      const made = makeView(image, pairs[index].camera, height, width);
      made.features.found = pairs[index].found ?? null;
      loaded.set(index, made);
    }
    return loaded.get(index);
  };
  const cameras = pairs.map(({ camera }) => camera);
  const [first, second] = await selectPair(cameras, async (index) => (await view(index)).features);
  if (pairs.length > 2) {
    notes.push(`2 of ${pairs.length} images used: ${pairs[first].file.name}, ${pairs[second].file.name}`);
  }
  const views = [await view(first), await view(second)];
  const share = Math.min(...views.map((each) => each.share));
  if (share < 1) {
    notes.push(`of each image the middle ${height} x ${width} is used, ${Math.round(100 * share)} % of it`);
  }
  return views;
}

/** Near, far and a common exposure, from matched points. */
function compareViews(views, model, options, notes) {
  const poses = views.map(({ camera }) => camera.pose);
  const [a, b] = poses.map(positionOf);
  if (norm(subtract(a, b)) <= SAME_POSITION * Math.max(norm(a), norm(b))) {
    throw new InputError(`${views[0].name} and ${views[1].name} are at the same position; depth needs a baseline`);
  }
  const pose = relativePose(poses[0], poses[1]);
  const { pairs, first, second } = matchViews(views[0], views[1]);
  const [firstK, secondK] = views.map(({ features }) => features.camera.K);
  const matches = alongEpipolarLines(pairs, first, second, firstK, secondK, pose);
  const found = depthRange(matches, pose, poses, model);
  const [near, far] = [options.near ?? found.near, options.far ?? found.far];
  if (!(near > 0 && near < far)) {
    throw new InputError(`near ${near} and far ${far} (${found.source}), expected 0 < near < far; give both`);
  }
  notes.push(`near ${near.toPrecision(3)} and far ${far.toPrecision(3)}: ${found.source}`);
  const exposure = compensateExposure(views, matches, model.height, model.width);
  if (exposure.compensated) {
    notes.push(`exposure differs by ${Math.round(100 * exposure.difference)} % between views; compensated`);
  }
  return { near, far, poses };
}

/** Depth and Gaussians in the unit and frame of the cameras; the network works in those of its training. */
async function predict(network, views, { near, far, poses }, model) {
  const { height, width } = model;
  const scale = model.near / near;
  const positions = poses.map(positionOf);
  const origin = [0, 1, 2].map((axis) => (positions[0][axis] + positions[1][axis]) / 2);
  const normalized = poses.map((pose) =>
    pose.map((value, index) => (index % 4 === 3 && index < 12 ? (value - origin[index >> 2]) * scale : value)),
  );
  const images = new Float32Array(2 * views[0].image.length);
  views.forEach((view, index) => images.set(view.image, index * view.image.length));
  const matrices = views.flatMap(({ intrinsics: [fx, fy, cx, cy] }) => [fx, 0, cx, 0, fy, cy, 0, 0, 1]);
  const outputs = await network.run({
    images: { data: images, dims: [2, 3, height, width] },
    extrinsics: { data: Float32Array.from(normalized.flat()), dims: [2, 4, 4] },
    intrinsics: { data: Float32Array.from(matrices), dims: [2, 3, 3] },
    near: { data: Float32Array.of(near * scale, near * scale), dims: [2] },
    far: { data: Float32Array.of(far * scale, far * scale), dims: [2] },
  });
  if (!outputs.means.every(Number.isFinite)) {
    throw new InputError("the network gave values that are not finite; choose WebAssembly, or other images");
  }
  const gaussians = {
    count: outputs.opacities.length,
    means: outputs.means.map((value, index) => value / scale + origin[index % 3]),
    scales: outputs.scales.map((value) => value / scale),
    quats: outputs.quats,
    opacities: outputs.opacities,
    sh: outputs.sh,
  };
  const depth = { data: outputs.depth.map((value) => value / scale), views: 2, height, width };
  return { depth, gaussians };
}

