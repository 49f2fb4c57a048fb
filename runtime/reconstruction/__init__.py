"""Images and cameras to depth, Gaussians and files, in one function."""
