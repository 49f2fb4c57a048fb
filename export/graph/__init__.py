"""Editing of traced ONNX graphs."""
