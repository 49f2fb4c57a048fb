/** A worker that runs the pipeline, so that the page stays responsive. */

import { InputError } from "./modules/errors.js";
import { run } from "./modules/pipeline.js";

self.onmessage = async ({ data: { files, cameras, options } }) => {
  const onProgress = (stage, share) => self.postMessage({ kind: "progress", stage, share });
  try {
    const result = await run(files, cameras, options, onProgress, new URL("./", import.meta.url));
    self.postMessage({ kind: "result", result });
  } catch (error) {
    const known = error instanceof InputError;
    const message = known ? error.message : `the page failed (${error}); reload it, or choose another provider`;
    if (!known) console.error(error);
    self.postMessage({ kind: "error", message });
  }
};
