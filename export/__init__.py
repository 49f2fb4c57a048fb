"""Export: from a checkpoint to ONNX graphs, verified against PyTorch before they are written."""

from ..runtime import startup as startup
