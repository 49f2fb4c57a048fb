"""Gaussians: their type, filters, point clouds and files."""
