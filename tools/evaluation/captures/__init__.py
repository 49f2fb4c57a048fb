"""Evaluation on real captures: images at pinned commits of public repositories."""
