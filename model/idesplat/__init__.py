"""IDESplat: depth probability boosting, the Gaussian focused module and the network."""
