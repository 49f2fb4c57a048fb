"""From a checkpoint to ONNX graphs that any runtime can load, checked against PyTorch before they are handed out."""

from ..runtime import startup as startup
