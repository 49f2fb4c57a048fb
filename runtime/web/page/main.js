/** The page: files in, progress, the scene and its downloads out. */

import { reconstruct, toSpz } from "./idesplat.js";
import { depthCanvas, medianDepth } from "./modules/depth_view.js";
import { filesOfDrop, readCameraFiles, sortFiles } from "./modules/dropped_files.js";

const RELOADED = "idesplat-reloaded"; // in sessionStorage: the page was reloaded once for cross-origin isolation
const MEGA = 1e6;

const element = (id) => /** @type {any} */ (document.getElementById(id));
const urls = { thumbnails: [], result: [] }; // of the blobs that the page shows now, by what they are for
const state = { images: [], cameraFiles: [], stop: null, running: false, viewer: null };

// ---- the environment

async function prepare() {
  if (!("serviceWorker" in navigator)) return;
  try {
    const registration = await navigator.serviceWorker.register("service-worker.js");
    await Promise.race([navigator.serviceWorker.ready, installationFailed(registration)]);
  } catch (error) {
    console.warn("without a service worker the page needs the network, and has one thread:", error);
    return;
  }
  // The worker isolates the page from the next load on; files that were chosen meanwhile would be lost with a reload.
  if (!globalThis.crossOriginIsolated && !filesChosen() && !sessionStorage.getItem(RELOADED)) {
    sessionStorage.setItem(RELOADED, "yes");
    location.reload();
  }
}

/** Rejects where the service worker cannot be installed: `ready` then waits for ever. */
function installationFailed({ installing }) {
  return new Promise((_, reject) => {
    installing?.addEventListener("statechange", () => {
      if (installing.state === "redundant") reject(new Error("a file could not be loaded or kept"));
    });
  });
}

async function describeEnvironment() {
  const model = await (await fetch("model.json")).json();
  const usable = model.webgpu && "gpu" in navigator;
  if (!usable) element("provider").value = "wasm";
  for (const option of element("provider").options) option.disabled = !usable && option.value !== "wasm";
  const without = model.webgpu ? "This browser has no WebGPU" : "The graph of this page was not made for WebGPU";
  const gpu = usable ? "WebGPU may be used" : without;
  const count = navigator.hardwareConcurrency ?? 1;
  const threads = globalThis.crossOriginIsolated ? `WebAssembly has ${count} threads` : "WebAssembly has one thread";
  element("environment").textContent = `${gpu}. ${threads}.`;
}

// ---- files

const filesChosen = () => state.images.length + state.cameraFiles.length > 0;

function addFiles(files) {
  const { images, cameraFiles, others } = sortFiles(files);
  state.images = replaced(state.images, images);
  state.cameraFiles = replaced(state.cameraFiles, cameraFiles);
  showError(others.length > 0 ? `${others[0].name}: is neither an image nor a file with cameras; left out` : null);
  showFiles();
}

/** Both lists of files; of those with the same name, the added one. */
function replaced(files, added) {
  const names = new Set(added.map((file) => file.name));
  return [...files.filter((file) => !names.has(file.name)), ...added];
}

function showFiles() {
  const thumbnails = urlsOf("thumbnails", state.images);
  const items = state.images.map((file, index) => {
    const item = document.createElement("li");
    const image = document.createElement("img");
    image.alt = "";
    image.src = thumbnails[index];
    item.append(image, file.name);
    item.title = file.name;
    return item;
  });
  element("chosen").replaceChildren(...items);
  const names = state.cameraFiles.map((file) => file.name).join(", ");
  const chosen = filesChosen();
  const cameras = names ? `Cameras: ${names}` : "No cameras: they are estimated from the images.";
  element("cameras").textContent = chosen ? `${state.images.length} images. ${cameras}` : "";
  element("focal-row").hidden = state.images.length === 0 || names !== "";
  element("start").disabled = state.running || !chosen;
  element("clear").hidden = !chosen;
}

/** URLs of the blobs, in place of those before for the same use, which kept their blobs in memory. */
function urlsOf(use, blobs) {
  urls[use].forEach((url) => URL.revokeObjectURL(url));
  urls[use] = blobs.map((blob) => URL.createObjectURL(blob));
  return urls[use];
}

function clear() {
  urlsOf("result", []);
  state.viewer?.dispose();
  Object.assign(state, { images: [], cameraFiles: [], viewer: null });
  element("files").value = "";
  element("result").hidden = true;
  showError(null);
  showFiles();
}

function showError(message) {
  element("error").hidden = message === null;
  element("error").textContent = message ?? "";
}

// ---- reconstruction

async function start() {
  const controller = new AbortController();
  state.stop = controller;
  showError(null);
  setRunning(true);
  const started = performance.now();
  try {
    const cameras = await readCameraFiles(state.cameraFiles);
    const provider = element("provider").value || null;
    const focal = element("focal").valueAsNumber;
    const { signal } = controller;
    const result = await reconstruct(state.images, cameras, { provider, focal, onProgress: showProgress, signal });
    await showResult(result, (performance.now() - started) / 1000);
  } catch (error) {
    showError(/** @type {Error} */ (error).message);
  } finally {
    setRunning(false);
  }
}

function setRunning(running) {
  state.running = running;
  element("progress").hidden = !running;
  element("stop").hidden = !running;
  element("start").disabled = running || !filesChosen();
  element("clear").disabled = running;
}

function showProgress({ stage, share }) {
  element("stage").textContent = share === null ? stage : `${stage}, ${Math.round(100 * share)} %`;
  if (share === null) element("bar").removeAttribute("value");
  else element("bar").value = share;
}

// ---- result

async function showResult(result, seconds) {
  element("result").hidden = false;
  const [ply, spz] = urlsOf("result", [result.ply, await toSpz(result.gaussians)]);
  element("ply").href = ply;
  element("spz").href = spz;
  showDepth(result);
  showNumbers(result, seconds);
  const notes = result.notes.map((line) => Object.assign(document.createElement("li"), { textContent: line }));
  element("notes").replaceChildren(...notes);
  await showScene(result);
  element("result").scrollIntoView();
  element("result").dataset.ready = "yes";
}

async function showScene(result) {
  try {
    state.viewer?.dispose();
    const fresh = element("view").cloneNode(); // a canvas keeps the context of the viewer before
    element("view").replaceWith(fresh);
    const { Viewer } = await import("./modules/viewer.js");
    state.viewer = new Viewer(fresh);
    await state.viewer.show(await result.ply.arrayBuffer(), result.cameras[0], medianDepth(result.depth));
    setSwinging(!matchMedia("(prefers-reduced-motion: reduce)").matches);
    element("view-problem").textContent = "";
  } catch (error) {
    const message = `The scene cannot be shown here (${error}); download it and open it in a splat viewer.`;
    element("view-problem").textContent = message;
  }
}

function setSwinging(on) {
  if (state.viewer) state.viewer.swinging = on;
  element("swing").setAttribute("aria-pressed", String(on));
}

function showDepth({ depth, cameras }) {
  const figures = cameras.map(({ name }, view) => {
    const figure = document.createElement("figure");
    const canvas = depthCanvas(depth, view);
    canvas.setAttribute("role", "img");
    canvas.setAttribute("aria-label", `Depth of ${name}`);
    const caption = Object.assign(document.createElement("figcaption"), { textContent: name });
    figure.append(canvas, caption);
    return figure;
  });
  element("depth").replaceChildren(...figures);
}

function showNumbers(result, seconds) {
  const stages = Object.entries(result.seconds).map(([name, value]) => `${name} ${value.toFixed(1)} s`);
  const device = result.provider === "webgpu" ? "WebGPU" : `WebAssembly, ${result.threads} threads`;
  const entries = {
    Gaussians: result.gaussians.count.toLocaleString("en"),
    Time: `${seconds.toFixed(1)} s (${stages.join(", ")})`,
    "Ran on": device,
    "WebAssembly memory": `${Math.round(result.memory / MEGA)} MB`,
    "Near, far": `${result.near.toPrecision(3)}, ${result.far.toPrecision(3)}`,
  };
  const parts = Object.entries(entries).flatMap(([name, value]) => [
    Object.assign(document.createElement("dt"), { textContent: name }),
    Object.assign(document.createElement("dd"), { textContent: value }),
  ]);
  element("numbers").replaceChildren(...parts);
}

// ---- events

element("files").addEventListener("change", (event) => addFiles([...event.target.files]));
element("focal").addEventListener("input", () => (element("focal-value").textContent = `${element("focal").value} mm`));
element("start").addEventListener("click", start);
element("stop").addEventListener("click", () => state.stop?.abort());
element("clear").addEventListener("click", clear);
element("reset").addEventListener("click", () => {
  setSwinging(false);
  state.viewer?.reset();
});
element("swing").addEventListener("click", () => setSwinging(element("swing").getAttribute("aria-pressed") !== "true"));
document.addEventListener("dragover", (event) => {
  event.preventDefault();
  element("drop").classList.add("over");
});
document.addEventListener("dragleave", () => element("drop").classList.remove("over"));
document.addEventListener("drop", async (event) => {
  event.preventDefault();
  element("drop").classList.remove("over");
  try {
    if (event.dataTransfer) addFiles(await filesOfDrop(event.dataTransfer));
  } catch (error) {
    const { message } = /** @type {Error} */ (error);
    showError(`the dropped files cannot be read (${message}); choose them instead, or copy them to another folder`);
  }
});

describeEnvironment().catch((error) => showError(`model.json cannot be loaded (${error}); copy the whole folder to the host`));
prepare();
