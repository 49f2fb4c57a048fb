"""Defaults that the commands and the library share; loading them costs nothing."""

CONTEXT_VIEWS = 2
HOLD_OUT_EVERY = 8
HELD_OUT_SCENES = 200  # synthetic ones
SYNTHETIC_TARGETS = 2  # held-out views of a synthetic scene
VIEW_COUNTS = (2, 3, 4, 6)  # of captures
