"""Refinement of Gaussians on the images that they were predicted from: a differentiable rasteriser and its optimiser."""
