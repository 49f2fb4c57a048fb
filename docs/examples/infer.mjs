// Run an exported graph in JavaScript:
//   node infer.mjs MODEL TENSORS VIEWS HEIGHT WIDTH
// TENSORS is a folder that write_tensors.py wrote; the outputs are written beside the inputs, as raw float32 files.
// In a browser, replace readFile by fetch; everything else stays the same.

import { readFile, writeFile } from "node:fs/promises";
import * as ort from "onnxruntime-web";

const [model, folder, ...numbers] = process.argv.slice(2);
const [views, height, width] = numbers.map(Number);
const shapes = {
  images: [views, 3, height, width],
  extrinsics: [views, 4, 4],
  intrinsics: [views, 3, 3],
  near: [views],
  far: [views],
};

const inputs = {};
for (const [name, shape] of Object.entries(shapes)) {
  const bytes = await readFile(`${folder}/${name}.f32`);
  const values = new Float32Array(bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.length));
  inputs[name] = new ort.Tensor("float32", values, shape);
}

const session = await ort.InferenceSession.create(new Uint8Array(await readFile(model)), {
  executionProviders: ["wasm"], // in a browser also "webgpu", for graphs exported with --target web
});
const outputs = await session.run(inputs);
for (const [name, { data, dims }] of Object.entries(outputs)) {
  await writeFile(`${folder}/${name}.f32`, new Uint8Array(data.buffer, data.byteOffset, data.byteLength));
  console.log(name, ...dims);
}
await session.release();
