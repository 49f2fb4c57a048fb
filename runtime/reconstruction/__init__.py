"""The whole flow in one function: images and cameras to depth, Gaussians and files."""
