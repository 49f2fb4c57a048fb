"""Refinement of Gaussians on posed images: a differentiable rasteriser and its optimiser."""
