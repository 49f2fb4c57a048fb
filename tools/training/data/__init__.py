"""Training data: synthetic scenes and captures, as tensors."""
