"""What the pipeline asks of a segmenter: the object's mask in every frame of a toss."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from jaxtyping import Bool
from numpy import ndarray as Array

from recordings.progress import Progress
from recordings.records import RgbdFrame


@dataclass(frozen=True, eq=False)
class FrameMask:
    """The object's pixels in the colour frame at `position` of a toss. `confidence` is 0 (nothing found) to 1."""

    position: int
    mask: Bool[Array, "h w"]
    confidence: float


@dataclass(frozen=True, eq=False)
class Example:
    """A frame whose mask was given: what the object looks like, for tosses that come without a mask."""

    frame: RgbdFrame
    mask: Bool[Array, "h w"]


@runtime_checkable
class Segmenter(Protocol):
    """Finds the object in every frame of one toss, from given masks or from nothing. One class per backend."""

    name: str

    def masks(
        self,
        frames: Sequence[RgbdFrame],
        given: Mapping[int, Bool[Array, "h w"]],
        example: Example | None,
        robot: Sequence[Bool[Array, "h w"]] | None,
        progress: Progress,
    ) -> Iterator[FrameMask]:
        """Yield one mask for every frame, in any order. `given` masks are taken as they are; `robot` pixels (one mask
        per frame, where the robot is known) never belong to the object. Raises BadInput where there is no object."""
        ...
