"""Evaluation on synthetic scenes, released datasets and real captures."""
