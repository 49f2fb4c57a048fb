"""What the networks share: layers, features, geometry, and the Gaussian adapter."""
