"""Every network this project knows, from its configuration or the name of a released checkpoint."""

from .config import PRESETS, DepthSplatConfig, IDESplatConfig
from .depthsplat.network import DepthSplat, DepthSplatDepth
from .idesplat.network import IDESplat

Network = IDESplat | DepthSplat | DepthSplatDepth


def build(preset: str | IDESplatConfig | DepthSplatConfig) -> Network:
    """The network of a preset's name or of a configuration, with initial weights. Raises KeyError if unknown."""
    config = PRESETS[preset] if isinstance(preset, str) else preset
    if isinstance(config, IDESplatConfig):
        return IDESplat(config)
    return DepthSplat(config) if config.gaussians else DepthSplatDepth(config)
