"""Bounds that a caller may give: of depth, and of the number of Gaussians."""

from math import inf

from ..errors import InputError


def check_depth_bounds(near: float | None, far: float | None, prefix: str = "--") -> None:
    """Raise InputError unless near and far, where given, are positive depths and near < far.

    prefix: of their names in messages.
    """
    for name, value in (("near", near), ("far", far)):
        if value is not None and not 0 < value < inf:
            raise InputError(f"{prefix}{name} {value:g}: expected a positive depth in scene units")
    if near is not None and far is not None and near >= far:
        raise InputError(f"{prefix}near {near:g} and {prefix}far {far:g}: expected near < far")


def check_max_gaussians(count: int, name: str = "--max-gaussians") -> None:
    """Raise InputError for a negative number of Gaussians. name: of the option in messages."""
    if count < 0:
        raise InputError(f"{name} {count}: expected a number of Gaussians, or 0 for all")
