"""Masks by XMem: a mask is followed by what the network remembers of earlier frames. Needs the published weights."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Float32, UInt8
from numpy import ndarray as Array
from torch import Tensor
from torch.nn import functional as F

from processing.segment.segmenter import Example, FrameMask, Segmenter
from processing.segment.xmem.checkpoint import load_network
from processing.segment.xmem.memory import Elements, Memory, MemorySettings
from processing.segment.xmem.network import Encoded, XMemNetwork
from recordings.errors import BadInput
from recordings.progress import Progress
from recordings.records import RgbdFrame

STRIDE = 16
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Of RGB 0..1 in the images that both encoders were first trained on."""


@dataclass(frozen=True)
class XMemSettings:
    """How XMem is run; the defaults are the paper's."""

    short_side_px: int = 480
    """Images are resized to this height or width, whichever is smaller."""
    memory: MemorySettings = field(default_factory=MemorySettings)


@dataclass(frozen=True)
class Frame:
    """Sizes of an image on its way to the network: as it came, resized, and the rim that makes it divisible by 16."""

    size: tuple[int, int]
    resized: tuple[int, int]

    @staticmethod
    def of(height: int, width: int, short_side_px: int) -> Frame:
        share = short_side_px / min(height, width)
        return Frame((height, width), (int(height * share), int(width * share)))

    @property
    def rim(self) -> tuple[int, int, int, int]:
        """Pixels to add left, right, above, below."""
        extra_h, extra_w = (-side % STRIDE for side in self.resized)
        return extra_w // 2, extra_w - extra_w // 2, extra_h // 2, extra_h - extra_h // 2

    @property
    def cells(self) -> tuple[int, int]:
        """Height and width at stride 16."""
        return (self.resized[0] + STRIDE - 1) // STRIDE, (self.resized[1] + STRIDE - 1) // STRIDE

    def image(self, color_rgb: UInt8[Array, "h w 3"], device: str) -> Float[Tensor, "1 3 a b"]:
        """The normalised image that the network sees."""
        if color_rgb.shape[:2] != self.size:
            found, wanted = color_rgb.shape[1::-1], self.size[::-1]
            raise BadInput(f"an image is {found}, the first one {wanted}; wanted images of one size")
        rgb = torch.tensor(color_rgb, device=device).permute(2, 0, 1)[None].float() / 255
        mean, deviation = (torch.tensor(x, device=device)[None, :, None, None] for x in (MEAN, DEVIATION))
        resized = F.interpolate((rgb - mean) / deviation, self.resized, mode="bilinear", align_corners=False)
        return F.pad(resized, self.rim)

    def mask(self, mask: Bool[Array, "h w"], device: str) -> Float[Tensor, "1 1 a b"]:
        """A mask as the network sees it: 0 and 1."""
        plane = torch.tensor(mask, device=device)[None, None].float()
        return F.pad(F.interpolate(plane, self.resized, mode="nearest"), self.rim)

    def back(self, probability: Float[Tensor, "1 1 a b"]) -> Array:
        """The network's answer at the size of the image as it came, (h, w)."""
        left, _, top, _ = self.rim
        inner = probability[..., top : top + self.resized[0], left : left + self.resized[1]]
        return F.interpolate(inner, self.size, mode="bilinear", align_corners=False)[0, 0].cpu().numpy()


class Pass:
    """One way through a video, from a known mask on: the network with its memory."""

    def __init__(self, network: XMemNetwork, frame: Frame, settings: XMemSettings, device: str) -> None:
        self._network, self._frame, self._device = network, frame, device
        self.memory = Memory(settings.memory, self._nowhere())
        self._since_memory = 0

    def _nowhere(self) -> Tensor:
        return torch.zeros(1, self._network.widths.hidden, *self._frame.cells, device=self._device)

    def forget_place(self) -> None:
        """Empty the sensory memory, which knows where the object is: for an example that is no neighbour in time."""
        self.memory.sensory = self._nowhere()

    @torch.inference_mode()
    def known(self, color_rgb: UInt8[Array, "h w 3"], mask: Bool[Array, "h w"]) -> None:
        """A frame whose mask is given goes into the memory."""
        image = self._frame.image(color_rgb, self._device)
        self._remember(image, self._network.encode(image), self._frame.mask(mask, self._device))

    @torch.inference_mode()
    def follow(
        self, color_rgb: UInt8[Array, "h w 3"], robot: Bool[Array, "h w"] | None = None, last: bool = False
    ) -> Float32[Array, "h w"]:
        """Probability of the object in the next frame. Robot pixels have none; after the last frame nothing is kept."""
        image = self._frame.image(color_rgb, self._device)
        seen = self._network.encode(image)
        self._since_memory += 1
        remember = self._since_memory >= self.memory.settings.every and not last
        readout = self.memory.read(seen.key, seen.selection)
        update = not remember and not last
        probability, self.memory.sensory = self._network.segment(seen, readout, self.memory.sensory, update)
        if robot is not None:
            probability = probability * (1 - self._frame.mask(robot, self._device))
        if remember:
            self._remember(image, seen, probability)
        out = self._frame.back(probability)
        return out if robot is None else np.where(robot, np.float32(0), out)

    def _remember(self, image: Tensor, seen: Encoded, probability: Tensor) -> None:
        """Into the working memory, and the deep update of the sensory one."""
        value = self._network.value(image, seen.f16, probability)
        self.memory.sensory = self._network.reinforced(value, self.memory.sensory)
        self.memory.add(Elements.new(seen.key, seen.shrinkage, seen.selection, value))
        self._since_memory = 0


class XMemSegmenter:
    """Segmenter by XMem's network. See `Segmenter`.

    `finder` is asked for a first mask where neither a mask nor an example is given: the first that it yields counts.
    """

    name = "xmem"

    def __init__(
        self,
        network: XMemNetwork,
        settings: XMemSettings | None = None,
        finder: Segmenter | None = None,
        device: str = "cpu",
    ) -> None:
        self._network = network.to(device).eval()
        self._settings = settings or XMemSettings()
        self._finder = finder
        self._device = device

    @staticmethod
    def from_weights(
        folder: Path | None,
        settings: XMemSettings | None = None,
        finder: Segmenter | None = None,
        device: str = "cpu",
    ) -> XMemSegmenter:
        """With the published weights in a user's folder. Raises BadInput that says where they come from."""
        return XMemSegmenter(load_network(folder), settings, finder, device)

    def masks(
        self,
        frames: Sequence[RgbdFrame],
        given: Mapping[int, Bool[Array, "h w"]],
        example: Example | None,
        robot: Sequence[Bool[Array, "h w"]] | None,
        progress: Progress,
    ) -> Iterator[FrameMask]:
        """Yield a mask for every frame: the first known one, then those after it, then those before it.

        Raises BadInput where there is no mask to start from, or one that does not fit.
        """
        height, width = frames[0].color_rgb.shape[:2]
        sizes = Frame.of(height, width, self._settings.short_side_px)
        known = {i: _checked(m, f"frame {i}", sizes) for i, m in given.items() if i < len(frames)}
        if not known and example is not None:
            mask = _checked(example.mask, "the example", sizes)
            run = self._pass(sizes, example.frame, mask)
            run.forget_place()
            yield from _followed(run, frames, range(len(frames)), {}, robot, progress)
            return
        first = FrameMask(min(known), known[min(known)], 1.0) if known else self._found(frames, robot, progress)
        yield first
        start = first.position
        for order in (range(start + 1, len(frames)), range(start - 1, -1, -1)):
            if order:
                run = self._pass(sizes, frames[start], first.mask)
                yield from _followed(run, frames, order, known, robot, progress)

    def _pass(self, sizes: Frame, frame: RgbdFrame, mask: Bool[Array, "h w"]) -> Pass:
        run = Pass(self._network, sizes, self._settings, self._device)
        run.known(frame.color_rgb, mask)
        return run

    def _found(
        self, frames: Sequence[RgbdFrame], robot: Sequence[Bool[Array, "h w"]] | None, progress: Progress
    ) -> FrameMask:
        if self._finder is None:
            raise BadInput(
                "xmem follows a mask, and none was given; wanted: a mask of the first frame (mask_first.png in the "
                "folder layout, masks/ in BundleSDF's), or run with --segmenter background, which finds the object"
            )
        return next(iter(self._finder.masks(frames, {}, None, robot, progress)))


def _followed(
    run: Pass,
    frames: Sequence[RgbdFrame],
    order: Sequence[int],
    known: Mapping[int, Bool[Array, "h w"]],
    robot: Sequence[Bool[Array, "h w"]] | None,
    progress: Progress,
) -> Iterator[FrameMask]:
    """One mask for every frame of `order`; known ones are taken as they are, and remembered."""
    for done, i in enumerate(order):
        progress.step(done, len(order), "masks")
        if i in known:
            run.known(frames[i].color_rgb, known[i])
            yield FrameMask(i, known[i], 1.0)
            continue
        block = None if robot is None else robot[i]
        probability = run.follow(frames[i].color_rgb, block, last=i == order[-1])
        yield FrameMask(i, probability > 0.5, confidence(probability))


def confidence(probability: Float32[Array, "h w"]) -> float:
    """The overlap (IoU) with the true mask that a mask at p > 0.5 expects, if p is right; 0 where it is empty."""
    mask = probability > 0.5
    inside = float(probability[mask].sum())
    return inside / (float(mask.sum()) + float(probability[~mask].sum())) if mask.any() else 0.0


def _checked(mask: Bool[Array, "h w"], where: str, sizes: Frame) -> Bool[Array, "h w"]:
    if mask.shape != sizes.size:
        found, wanted = mask.shape[::-1], sizes.size[::-1]
        raise BadInput(f"the given mask of {where} is {found}, the image {wanted}; wanted the same size")
    if not mask.any():
        raise BadInput(f"the given mask of {where} is empty; wanted the object's pixels, or no mask at all")
    return mask
