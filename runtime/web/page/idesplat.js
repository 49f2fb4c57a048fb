/**
 * Images to 3D Gaussians in the browser. `idesplat.d.ts` describes what is exported.
 *
 *   import { reconstruct } from "./idesplat.js";
 *   const { ply, depth, gaussians } = await reconstruct(files, cameras, { provider: "wasm", onProgress });
 */

import { parseColmap } from "./modules/colmap.js";
import { InputError } from "./modules/errors.js";
import { toPly, toSpz } from "./modules/splat_files.js";

const STOPPED = "stopped";

export { InputError, parseColmap, toPly, toSpz };

/** @type {import("./idesplat.d.ts").reconstruct} */
export function reconstruct(files, cameras, options = {}) {
  const { provider = null, near, far, focal, onProgress = () => {}, signal } = options;
  if (signal?.aborted) return Promise.reject(new InputError(STOPPED)); // its event does not come again
  // A worker from a blob has the page's content security policy; one from a file has that of the file's response.
  const source = `import ${JSON.stringify(new URL("./worker.js", import.meta.url).href)};`;
  const url = URL.createObjectURL(new Blob([source], { type: "text/javascript" }));
  const worker = new Worker(url, { type: "module" });
  const done = new Promise((resolve, reject) => {
    // Without a message: its files could not be loaded.
    const reason = (event) => event.message ?? "its files cannot be loaded";
    worker.onerror = (event) => reject(new InputError(`the worker failed (${reason(event)}); reload the page`));
    worker.onmessage = ({ data }) => {
      if (data.kind === "progress") onProgress({ stage: data.stage, share: data.share });
      else if (data.kind === "error") reject(new InputError(data.message));
      else resolve({ ...data.result, ply: toPly(data.result.gaussians) });
    };
    signal?.addEventListener("abort", () => reject(new InputError(STOPPED)));
  });
  worker.postMessage({ files: [...files], cameras, options: { provider, near, far, focal } });
  const end = () => {
    worker.terminate();
    URL.revokeObjectURL(url);
  };
  return /** @type {any} */ (done.finally(end));
}
