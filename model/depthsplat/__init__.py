"""DepthSplat: its depth stage, its Gaussian regressor and the network."""
