"""Cameras and the files that hold them."""
