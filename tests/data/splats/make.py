"""How the files beside this one were made: one scene, written by other people's programs.

pip install gsplat plyfile torch
python make.py
for out in scene.v3.spz scene.compressed.ply scene.sog scene.glb; do
    npx @playcanvas/splat-transform@2.7.1 -q -w -g cpu --spz-version 3 scene.ply $out
done
npx @playcanvas/splat-transform@2.7.1 -q -w -g cpu scene.ply scene.v4.spz
rm scene.ply
"""

import numpy as np
import torch
from gsplat.exporter import export_splats
from plyfile import PlyData, PlyElement

COUNT, COEFFICIENTS = 270, 9  # two chunks of a compressed .ply, spherical harmonics of degree 2

rng = np.random.default_rng(7)
scene = {
    "means": rng.uniform([-2, -1, 1], [3, 0.5, 9], (COUNT, 3)),
    "scales": np.exp(rng.uniform(-6, 0, (COUNT, 3))),
    "quats": rng.normal(size=(COUNT, 4)),
    "opacities": rng.uniform(0.02, 0.98, COUNT),
    "sh": rng.uniform(-0.9, 0.9, (COUNT, COEFFICIENTS, 3)),
}
scene["quats"] /= np.linalg.norm(scene["quats"], axis=1, keepdims=True)
scene["sh"][:, 0] *= 1.9  # colours nearly from 0 to 1
scene = {name: values.astype(np.float32) for name, values in scene.items()}
np.savez_compressed("scene.npz", **scene)

logits = np.log(scene["opacities"] / (1 - scene["opacities"]))
columns = {name: scene["means"][:, axis] for axis, name in enumerate("xyz")}
columns |= {f"f_dc_{channel}": scene["sh"][:, 0, channel] for channel in range(3)}
rest = scene["sh"][:, 1:].transpose(0, 2, 1).reshape(COUNT, -1)
columns |= {f"f_rest_{index}": rest[:, index] for index in range(rest.shape[1])}
columns["opacity"] = logits
columns |= {f"scale_{axis}": np.log(scene["scales"][:, axis]) for axis in range(3)}
columns |= {f"rot_{part}": scene["quats"][:, part] for part in range(4)}
table = np.empty(COUNT, [(name, "<f4") for name in columns])
for name, values in columns.items():
    table[name] = values
PlyData([PlyElement.describe(table, "vertex")], byte_order="<").write("scene.ply")

tensors = [torch.from_numpy(values) for values in (scene["means"], np.log(scene["scales"]), scene["quats"], logits)]
sh = torch.from_numpy(scene["sh"])
export_splats(*tensors, sh[:, :1], sh[:, 1:], format="splat", save_to="scene.splat")
export_splats(*tensors, sh[:, :1], sh[:, 1:], format="ply_compressed", save_to="scene.gsplat.compressed.ply")
