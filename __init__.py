"""Feed-forward 3D Gaussian splatting: released checkpoints to ONNX, images to splats."""
