"""What to do about differences of exposure between views, by its names in options."""

from enum import StrEnum

from ..errors import InputError


class ExposureMode(StrEnum):
    """auto: compensate significant differences (`exposure`). off: leave the images as they are."""

    AUTO = "auto"
    OFF = "off"


def parse_exposure_mode(text: str) -> ExposureMode:
    """The mode of this name; raises InputError."""
    if text not in list(ExposureMode):
        raise InputError(f"exposure {text}: expected one of {', '.join(ExposureMode)}")
    return ExposureMode(text)
