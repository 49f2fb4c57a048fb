/** The network: its graph, fetched and unpacked, and an ONNX Runtime session on WebGPU or WebAssembly. */

import { InputError } from "./errors.js";

const RUNTIMES = {
  wasm: { script: "ort.wasm.min.mjs", engine: "ort-wasm-simd-threaded" },
  webgpu: { script: "ort.webgpu.min.mjs", engine: "ort-wasm-simd-threaded.asyncify" },
};
const GZIP = [0x1f, 0x8b];
const MAX_THREADS = 8; // more gain nothing on graphs of this size

// Memories of WebAssembly that were made in this worker, to tell how large they grew.
const memories = [];
WebAssembly.Memory = class extends WebAssembly.Memory {
  constructor(descriptor) {
    super(descriptor);
    memories.push(this);
  }
};

/** Bytes of WebAssembly's memories, which never shrink. */
export function wasmBytes() {
  return memories.reduce((sum, memory) => sum + memory.buffer.byteLength, 0);
}

/** @typedef {"wasm" | "webgpu"} Provider */
/** @typedef {{ name: string, file: string, views: number, height: number, width: number,
 *   near: number, far: number, webgpu: boolean }} Model */

/** Fetch a file of the page, unpacked if it is packed. @param {URL} url @param {(share: number) => void} onShare */
export async function fetchFile(url, onShare = () => {}) {
  let response;
  try {
    response = await fetch(url);
  } catch {
    throw new InputError(`${url.pathname}: cannot be loaded; connect to the network, or reload the page`);
  }
  if (!response.ok || !response.body) {
    throw new InputError(`${url.pathname}: the server answers ${response.status}; copy the whole folder to the host`);
  }
  const total = Number(response.headers.get("Content-Length") ?? 0);
  const parts = [];
  let received = 0;
  for (const reader = response.body.getReader(); ; ) {
    const { done, value } = await reader.read();
    if (done) break;
    parts.push(value);
    received += value.length;
    if (total > 0) onShare(Math.min(received / total, 1));
  }
  const blob = new Blob(parts);
  const start = new Uint8Array(await blob.slice(0, 2).arrayBuffer());
  if (start[0] !== GZIP[0] || start[1] !== GZIP[1]) return blob.arrayBuffer();
  return new Response(blob.stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer();
}

/** The description of the model beside the page. @param {URL} base @returns {Promise<Model>} */
export async function readModel(base) {
  return JSON.parse(new TextDecoder().decode(await fetchFile(new URL("model.json", base))));
}

/** A loaded graph. */
export class Network {
  /** @param {any} ort @param {any} session @param {Provider} provider @param {number} threads @param {Model} model */
  constructor(ort, session, provider, threads, model) {
    Object.assign(this, { ort, session, provider, threads, model });
  }

  /**
   * Open the graph. asked: null tries WebGPU, then WebAssembly.
   * @param {URL} base @param {Model} model @param {Provider | null} asked
   * @param {(share: number) => void} onShare of the download @param {(line: string) => void} note
   */
  static async open(base, model, asked, onShare, note) {
    const graph = new Uint8Array(await fetchFile(new URL(model.file, base), onShare));
    const candidates = asked ? [asked] : ["webgpu", "wasm"];
    for (const provider of candidates) {
      const problem = provider === "webgpu" ? await webgpuProblem(model, asked !== null) : null;
      if (problem) {
        if (asked) throw new InputError(`${problem}; choose WebAssembly`);
        note(`${problem}; WebAssembly is used`);
        continue;
      }
      try {
        return await openWith(/** @type {Provider} */ (provider), base, model, graph);
      } catch (error) {
        if (asked || provider === "wasm") throw explained(error, provider);
        note(`WebGPU could not be used (${firstLine(error)}); WebAssembly is used instead`);
      }
    }
    throw new InputError("neither WebGPU nor WebAssembly runs here; use a current browser");
  }

  /** Run the graph. @param {Record<string, { data: Float32Array, dims: number[] }>} inputs */
  async run(inputs) {
    const feeds = Object.entries(inputs).map(([name, { data, dims }]) => {
      return [name, new this.ort.Tensor("float32", data, dims)];
    });
    try {
      const outputs = await this.session.run(Object.fromEntries(feeds));
      const found = await Promise.all(Object.entries(outputs).map(async ([name, tensor]) => [name, await tensor.getData()]));
      return Object.fromEntries(found);
    } catch (error) {
      throw explained(error, this.provider);
    }
  }

  async close() {
    await this.session.release();
  }
}

async function openWith(provider, base, model, graph) {
  const { script, engine } = RUNTIMES[provider];
  const folder = new URL("lib/ort/", base);
  const ort = await import(new URL(script, folder).href);
  const threads = globalThis.crossOriginIsolated ? Math.min(navigator.hardwareConcurrency ?? 1, MAX_THREADS) : 1;
  ort.env.wasm.wasmBinary = await fetchFile(new URL(`${engine}.wasm.gz`, folder));
  ort.env.wasm.wasmPaths = { mjs: new URL(`${engine}.mjs`, folder).href };
  ort.env.wasm.numThreads = threads;
  ort.env.logLevel = "error";
  const session = await ort.InferenceSession.create(graph, { executionProviders: [provider] });
  return new Network(ort, session, provider, threads, model);
}

/** Why WebGPU cannot be used; null if it can. @param {Model} model @param {boolean} inSoftware may be used */
async function webgpuProblem(model, inSoftware) {
  // ONNX Runtime 1.30 computes some convolutions of other graphs wrongly on WebGPU, without an error.
  if (!model.webgpu) return "the graph of this page was not exported for WebGPU";
  const { gpu } = /** @type {any} */ (navigator);
  if (!gpu) return "this browser has no WebGPU";
  const adapter = await gpu.requestAdapter().catch(() => null);
  if (!adapter) return "this browser has no WebGPU adapter";
  // WebAssembly is faster than an adapter that computes on the processor.
  return adapter.info?.isFallbackAdapter && !inSoftware ? "the WebGPU adapter is software" : null;
}

function firstLine(error) {
  return String(error?.message ?? error).split("\n")[0].slice(0, 200);
}

function explained(error, provider) {
  const line = firstLine(error);
  if (/memory|alloc|bad_alloc/i.test(line)) {
    return new InputError(`there is not enough memory (${line}); close other tabs and try again`);
  }
  const other = provider === "webgpu" ? "choose WebAssembly" : "try a current browser";
  return new InputError(`the network cannot run on ${provider} (${line}); ${other}`);
}
