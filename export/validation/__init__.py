"""Comparison of exported graphs with the network in PyTorch."""
