"""Rotations, trajectories, and depth maps as geometry."""
