"""Rasterisation of Gaussians on the CPU."""
