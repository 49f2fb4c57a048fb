"""Convolutions of few channels, computed in channels-last order for training on a CPU.

In the order that images have, oneDNN's gradient of a 3x3 convolution's weights takes up to seven times as long, with 8
channels in bfloat16. With more channels the change of order costs as much as it gains; group normalisation, which
stands between the convolutions, is slow in channels-last order.
"""

from torch import Tensor, channels_last, nn

MOST_CHANNELS = 8
KERNEL = (3, 3)


def use_channels_last(model: nn.Module) -> None:
    """Compute the model's 3x3 convolutions of at most MOST_CHANNELS input channels in channels-last order."""
    for module in model.modules():
        if isinstance(module, nn.Conv2d) and module.kernel_size == KERNEL and module.in_channels <= MOST_CHANNELS:
            module.register_forward_pre_hook(_input_in_channels_last)
            module.register_forward_hook(_output_in_image_order)


def _input_in_channels_last(_: nn.Module, inputs: tuple[Tensor]) -> tuple[Tensor]:
    return (inputs[0].contiguous(memory_format=channels_last),)


def _output_in_image_order(_: nn.Module, __: tuple[Tensor], output: Tensor) -> Tensor:
    return output.contiguous()
