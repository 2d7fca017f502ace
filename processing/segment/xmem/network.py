"""XMem's network (Cheng and Schwing, ECCV 2022) for one object, written from its published description.

Attribute names are those of the published checkpoint, because its tensors are found by them: see layers.txt.
Planes are (1, channels, height, width); the number in a name (`f16`) is the stride in image pixels.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F


@dataclass(frozen=True)
class Widths:
    """Channels of the layers; the defaults are the published network's."""

    base: int = 64
    """Of the first convolution of both encoders; stride 4, 8, 16 of the key encoder have 4, 8, 16 times as many."""
    key: int = 64
    value: int = 512
    hidden: int = 64
    """Of the sensory memory."""
    deep: int = 512
    """Of the decoder at stride 16."""
    shallow: int = 256
    """Of the decoder at strides 8 and 4."""
    attention_share: int = 16
    """The channel attention's middle layer has so many times fewer channels."""


@dataclass(frozen=True, eq=False)
class Encoded:
    """The key encoder's output for one image."""

    key: Float[Tensor, "1 k h w"]
    shrinkage: Float[Tensor, "1 1 h w"]
    """At least 1: how sharply a memory element answers."""
    selection: Float[Tensor, "1 k h w"]
    """0..1: which channels of the key a query looks at."""
    f16: Float[Tensor, "1 c h w"]
    f8: Float[Tensor, "1 c2 h2 w2"]
    f4: Float[Tensor, "1 c4 h4 w4"]


class Bottleneck(nn.Module):
    """Residual block of ResNet50 (He et al. 2016), the stride at its 3x3 convolution."""

    def __init__(self, inward: int, width: int, stride: int) -> None:
        super().__init__()
        outward = 4 * width
        self.conv1, self.bn1 = nn.Conv2d(inward, width, 1, bias=False), nn.BatchNorm2d(width)
        self.conv2, self.bn2 = nn.Conv2d(width, width, 3, stride, 1, bias=False), nn.BatchNorm2d(width)
        self.conv3, self.bn3 = nn.Conv2d(width, outward, 1, bias=False), nn.BatchNorm2d(outward)
        self.downsample = _shortcut(inward, outward, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)))
        y = F.relu(self.bn2(self.conv2(y)))
        return F.relu(self.bn3(self.conv3(y)) + self.downsample(x))


class BasicBlock(nn.Module):
    """Residual block of ResNet18."""

    def __init__(self, inward: int, outward: int, stride: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(inward, outward, 3, stride, 1, bias=False), nn.BatchNorm2d(outward)
        self.conv2, self.bn2 = nn.Conv2d(outward, outward, 3, 1, 1, bias=False), nn.BatchNorm2d(outward)
        self.downsample = _shortcut(inward, outward, stride)

    def forward(self, x: Tensor) -> Tensor:
        y = F.relu(self.bn1(self.conv1(x)))
        return F.relu(self.bn2(self.conv2(y)) + self.downsample(x))


def _shortcut(inward: int, outward: int, stride: int) -> nn.Module:
    if stride == 1 and inward == outward:
        return nn.Identity()
    return nn.Sequential(nn.Conv2d(inward, outward, 1, stride, bias=False), nn.BatchNorm2d(outward))


def _bottlenecks(inward: int, width: int, count: int, stride: int) -> nn.Sequential:
    rest = [Bottleneck(4 * width, width, 1) for _ in range(count - 1)]
    return nn.Sequential(Bottleneck(inward, width, stride), *rest)


def _basics(inward: int, outward: int, count: int, stride: int) -> nn.Sequential:
    rest = [BasicBlock(outward, outward, 1) for _ in range(count - 1)]
    return nn.Sequential(BasicBlock(inward, outward, stride), *rest)


class KeyEncoder(nn.Module):
    """ResNet50 down to stride 16: image -> features at strides 16, 8 and 4."""

    def __init__(self, base: int) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(3, base, 7, 2, 3, bias=False), nn.BatchNorm2d(base)
        self.res2 = _bottlenecks(base, base, 3, 1)
        self.layer2 = _bottlenecks(4 * base, 2 * base, 4, 2)
        self.layer3 = _bottlenecks(8 * base, 4 * base, 6, 2)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        start = F.max_pool2d(F.relu(self.bn1(self.conv1(image))), 3, 2, 1)
        f4 = self.res2(start)
        f8 = self.layer2(f4)
        return self.layer3(f8), f8, f4


class KeyProjection(nn.Module):
    """Key, shrinkage (>= 1) and selection (0..1) from the features at stride 16."""

    def __init__(self, inward: int, key: int) -> None:
        super().__init__()
        self.key_proj = nn.Conv2d(inward, key, 3, padding=1)
        self.d_proj = nn.Conv2d(inward, 1, 3, padding=1)
        self.e_proj = nn.Conv2d(inward, key, 3, padding=1)

    def forward(self, f16: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return self.key_proj(f16), self.d_proj(f16).square() + 1, torch.sigmoid(self.e_proj(f16))


class ResidualBlock(nn.Module):
    """Two convolutions, each after its activation; the shortcut is a 3x3 convolution where widths differ."""

    def __init__(self, inward: int, outward: int) -> None:
        super().__init__()
        self.downsample = nn.Identity() if inward == outward else nn.Conv2d(inward, outward, 3, padding=1)
        self.conv1 = nn.Conv2d(inward, outward, 3, padding=1)
        self.conv2 = nn.Conv2d(outward, outward, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        return self.conv2(F.relu(self.conv1(F.relu(x)))) + self.downsample(x)


class _ChannelGate(nn.Module):
    def __init__(self, width: int, share: int) -> None:
        super().__init__()
        layers = (nn.Flatten(), nn.Linear(width, width // share), nn.ReLU(), nn.Linear(width // share, width))
        self.mlp = nn.Sequential(*layers)

    def forward(self, x: Tensor) -> Tensor:
        says = self.mlp(x.mean((2, 3))) + self.mlp(x.amax((2, 3)))
        return x * torch.sigmoid(says)[..., None, None]


class _SpatialGate(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.spatial = nn.Sequential()
        self.spatial.add_module("conv", nn.Conv2d(2, 1, 7, padding=3))

    def forward(self, x: Tensor) -> Tensor:
        pooled = torch.cat([x.amax(1, keepdim=True), x.mean(1, keepdim=True)], 1)
        return x * torch.sigmoid(self.spatial(pooled))


class Attention(nn.Module):
    """Convolutional block attention (Woo et al. 2018): which channels, then where."""

    def __init__(self, width: int, share: int) -> None:
        super().__init__()
        self.ChannelGate = _ChannelGate(width, share)
        self.SpatialGate = _SpatialGate()

    def forward(self, x: Tensor) -> Tensor:
        return self.SpatialGate(self.ChannelGate(x))


class FeatureFusion(nn.Module):
    """Features of the image and of the object become one."""

    def __init__(self, image: int, thing: int, outward: int, share: int) -> None:
        super().__init__()
        self.block1 = ResidualBlock(image + thing, outward)
        self.attention = Attention(outward, share)
        self.block2 = ResidualBlock(outward, outward)

    def forward(self, image: Tensor, thing: Tensor) -> Tensor:
        both = self.block1(torch.cat([image, thing], 1))
        return self.block2(both + self.attention(both))


def _gated(values: Tensor, hidden: Tensor) -> Tensor:
    """Sensory memory after an update: h' = f h (1 - u) + u n, where one convolution gives f, u and n."""
    forget, update, new = values.chunk(3, dim=1)
    forget, update = torch.sigmoid(forget), torch.sigmoid(update)
    return forget * hidden * (1 - update) + update * torch.tanh(new)


class HiddenReinforce(nn.Module):
    """The deep update of the sensory memory, from a new value."""

    def __init__(self, value: int, hidden: int) -> None:
        super().__init__()
        self.transform = nn.Conv2d(value + hidden, 3 * hidden, 3, padding=1)

    def forward(self, value: Tensor, hidden: Tensor) -> Tensor:
        return _gated(self.transform(torch.cat([value, hidden], 1)), hidden)


class HiddenUpdate(nn.Module):
    """The update of the sensory memory in every frame, from the decoder's features at three strides."""

    def __init__(self, widths: tuple[int, int, int], width: int, hidden: int) -> None:
        super().__init__()
        self.g16_conv = nn.Conv2d(widths[0], width, 1)
        self.g8_conv = nn.Conv2d(widths[1], width, 1)
        self.g4_conv = nn.Conv2d(widths[2], width, 1)
        self.transform = nn.Conv2d(width + hidden, 3 * hidden, 3, padding=1)

    def forward(self, g16: Tensor, g8: Tensor, g4: Tensor, hidden: Tensor) -> Tensor:
        seen = self.g16_conv(g16) + self.g8_conv(F.avg_pool2d(g8, 2)) + self.g4_conv(F.avg_pool2d(g4, 4))
        return _gated(self.transform(torch.cat([seen, hidden], 1)), hidden)


class ValueEncoder(nn.Module):
    """ResNet18 to stride 16 on image, mask and other objects' masks, fused with the key encoder's features."""

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        base = widths.base
        self.conv1, self.bn1 = nn.Conv2d(5, base, 7, 2, 3, bias=False), nn.BatchNorm2d(base)
        self.layer1 = _basics(base, base, 2, 1)
        self.layer2 = _basics(base, 2 * base, 2, 2)
        self.layer3 = _basics(2 * base, 4 * base, 2, 2)
        self.fuser = FeatureFusion(16 * base, 4 * base, widths.value, widths.attention_share)
        self.hidden_reinforce = HiddenReinforce(widths.value, widths.hidden)

    def forward(self, image: Tensor, f16: Tensor, mask: Tensor) -> Tensor:
        others = torch.zeros_like(mask)
        start = self.bn1(self.conv1(torch.cat([image, mask, others], 1)))
        g16 = self.layer3(self.layer2(self.layer1(F.relu(F.max_pool2d(start, 3, 2, 1)))))
        return self.fuser(f16, g16)


class UpsampleBlock(nn.Module):
    """Twice the resolution, joined by the image's features there."""

    def __init__(self, skip: int, inward: int, outward: int) -> None:
        super().__init__()
        self.skip_conv = nn.Conv2d(skip, inward, 3, padding=1)
        self.out_conv = ResidualBlock(inward, outward)

    def forward(self, skip: Tensor, g: Tensor) -> Tensor:
        larger = F.interpolate(g, scale_factor=2, mode="bilinear", align_corners=False)
        return self.out_conv(self.skip_conv(skip) + larger)


class Decoder(nn.Module):
    """Memory readout and sensory memory -> logits at stride 4 and the sensory memory after this frame."""

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        base, deep, shallow = widths.base, widths.deep, widths.shallow
        self.fuser = FeatureFusion(16 * base, widths.value + widths.hidden, deep, widths.attention_share)
        self.hidden_update = HiddenUpdate((deep, shallow, shallow + 1), shallow, widths.hidden)
        self.up_16_8 = UpsampleBlock(8 * base, deep, shallow)
        self.up_8_4 = UpsampleBlock(4 * base, shallow, shallow)
        self.pred = nn.Conv2d(shallow, 1, 3, padding=1)

    def forward(self, seen: Encoded, readout: Tensor, hidden: Tensor, update: bool) -> tuple[Tensor, Tensor]:
        g16 = self.fuser(seen.f16, torch.cat([readout, hidden], 1))
        g8 = self.up_16_8(seen.f8, g16)
        g4 = self.up_8_4(seen.f4, g8)
        logits = self.pred(F.relu(g4))
        if update:
            hidden = self.hidden_update(g16, g8, torch.cat([g4, logits], 1), hidden)
        return logits, hidden


class XMemNetwork(nn.Module):
    """The four learned parts. Images are normalised RGB whose sides are multiples of 16."""

    def __init__(self, widths: Widths | None = None) -> None:
        super().__init__()
        self.widths = widths or Widths()
        self.key_encoder = KeyEncoder(self.widths.base)
        self.value_encoder = ValueEncoder(self.widths)
        self.key_proj = KeyProjection(16 * self.widths.base, self.widths.key)
        self.decoder = Decoder(self.widths)

    def encode(self, image: Float[Tensor, "1 3 h w"]) -> Encoded:
        """Key, shrinkage, selection and features of an image."""
        f16, f8, f4 = self.key_encoder(image)
        key, shrinkage, selection = self.key_proj(f16)
        return Encoded(key, shrinkage, selection, f16, f8, f4)

    def value(
        self, image: Float[Tensor, "1 3 h w"], f16: Float[Tensor, "1 c a b"], probability: Float[Tensor, "1 1 h w"]
    ) -> Float[Tensor, "1 v a b"]:
        """What is remembered of an image whose object is known."""
        return self.value_encoder(image, f16, probability)

    def reinforced(self, value: Float[Tensor, "1 v a b"], hidden: Float[Tensor, "1 z a b"]) -> Float[Tensor, "1 z a b"]:
        """Sensory memory after a deep update."""
        return self.value_encoder.hidden_reinforce(value, hidden)

    def segment(
        self, seen: Encoded, readout: Float[Tensor, "1 v a b"], hidden: Float[Tensor, "1 z a b"], update: bool
    ) -> tuple[Float[Tensor, "1 1 h w"], Float[Tensor, "1 z a b"]]:
        """The object's probability in every pixel and the sensory memory, updated by this frame where asked.

        Background counts as a second object of probability 1 - p, and both are weighed by their odds (soft
        aggregation, Oh et al. 2019): p' = p^2 / (p^2 + (1 - p)^2), which is the sigmoid of twice the logit.
        """
        logits, hidden = self.decoder(seen, readout, hidden, update)
        logits = F.interpolate(logits, scale_factor=4, mode="bilinear", align_corners=False)
        return torch.sigmoid(2 * logits), hidden
