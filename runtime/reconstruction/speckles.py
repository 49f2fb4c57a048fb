"""Speckles of depth maps, as wrong matches leave them where nothing in the images tells the depth."""

import cv2
import numpy as np

LARGEST = 20  # pixels
JUMP = 0.03  # difference of the depths of neighbouring pixels, relative, that parts their surfaces
UNITS = 1000  # to 1 of the logarithm of depth: OpenCV wants integers
SPECKLE = 0  # what OpenCV writes into them; all depths are above


def find_speckles(depth: np.ndarray) -> np.ndarray:
    """Which pixels are of a surface of LARGEST pixels or fewer that depth jumps around, bool [height, width].

    depth: z-depth, float32 [height, width].
    """
    levels = (np.log(depth / depth.min()) * UNITS + SPECKLE + 1).astype(np.int16)
    cv2.filterSpeckles(levels, SPECKLE, LARGEST, JUMP * UNITS)
    return levels == SPECKLE
