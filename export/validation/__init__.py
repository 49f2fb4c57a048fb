"""Verification of exported graphs against the network in PyTorch."""
