"""The networks in PyTorch, written so that they can be exported: no custom operators, no linear solvers.

Each architecture is a package with a `Family` object, and a line in registry.py.
"""

from .checkpoint import load_checkpoint as load_checkpoint
from .registry import PRESETS as PRESETS
from .registry import build as build
