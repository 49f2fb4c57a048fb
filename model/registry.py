"""Every network that this project knows, by its configuration or by the name of a preset."""

from .common.network import Network
from .config import EncoderConfig
from .depthsplat.family import DEPTHSPLAT
from .family import Family
from .idesplat.family import IDESPLAT

FAMILIES: tuple[Family, ...] = (IDESPLAT, DEPTHSPLAT)
PRESETS: dict[str, EncoderConfig] = {name: config for family in FAMILIES for name, config in family.presets.items()}


def family_of(config: EncoderConfig) -> Family:
    """The family that a configuration belongs to. Raises TypeError if there is none."""
    for family in FAMILIES:
        if isinstance(config, family.config):
            return family
    raise TypeError(f"{type(config).__name__} is the configuration of no family in model/registry.py")


def build(preset: str | EncoderConfig) -> Network:
    """The network of a preset's name or of a configuration, with initial weights. Raises KeyError if unknown."""
    config = PRESETS[preset] if isinstance(preset, str) else preset
    return family_of(config).build(config)
