"""ONNX models: metadata, sessions, and the predictor."""
