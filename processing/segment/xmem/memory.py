"""XMem's three memories of one object: sensory (every frame), working (every few frames), long-term (consolidated).

A memory element is a column: its key (k), shrinkage, selection and value. See vision facts B and the paper (ECCV 2022).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from recordings.errors import BadInput


@dataclass(frozen=True)
class MemorySettings:
    """Sizes of the memories; the defaults are the paper's."""

    every: int = 5
    """Every so many frames one goes into the working memory (r)."""
    working_most: int = 10
    """Frames at which the working memory is consolidated (T_max)."""
    working_least: int = 5
    """Frames that stay: the first one and the most recent ones (T_min)."""
    prototypes: int = 128
    """Elements that a consolidation leaves (P)."""
    long_most: int = 10_000
    """Elements of the long-term memory (LT_max); the least used leave first."""
    top_k: int = 30
    """Elements that a reading uses."""

    def __post_init__(self) -> None:
        if not 1 <= self.working_least < self.working_most or self.long_most < self.prototypes:
            raise BadInput(f"{self}; wanted 1 <= working_least < working_most and prototypes <= long_most")


@dataclass(frozen=True, eq=False)
class Elements:
    """Columns of memory and how much they were used."""

    key: Float[Tensor, "k n"]
    shrinkage: Float[Tensor, "1 n"]
    selection: Float[Tensor, "k n"]
    value: Float[Tensor, "v n"]
    used: Float[Tensor, " n"]
    """Sum of the shares that readings gave to the element."""
    lived: Float[Tensor, " n"]
    """Readings since it was stored."""

    @staticmethod
    def new(key: Tensor, shrinkage: Tensor, selection: Tensor, value: Tensor) -> Elements:
        """Elements that no reading has seen, from planes (1, c, h, w) or columns (c, n)."""
        k, s, e, v = (x[0].flatten(1) if x.ndim == 4 else x for x in (key, shrinkage, selection, value))
        never = torch.zeros(k.shape[1], device=key.device)
        return Elements(k, s, e, v, never, never)

    def __len__(self) -> int:
        return int(self.key.shape[1])

    @property
    def usage(self) -> Float[Tensor, " n"]:
        """Share used per reading; 0 where there was no reading."""
        return self.used / self.lived.clamp(min=1)

    def __getitem__(self, which: slice | Int[Tensor, " m"] | Bool[Tensor, " n"]) -> Elements:
        return Elements(*(x[..., which] for x in vars(self).values()))

    def joined(self, other: Elements) -> Elements:
        """Both, in order."""
        return Elements(*(torch.cat(pair, -1) for pair in zip(vars(self).values(), vars(other).values(), strict=True)))

    def read(self, shares: Float[Tensor, "n q"]) -> Elements:
        """The same elements after a reading that gave them these shares."""
        return replace(self, used=self.used + shares.sum(1), lived=self.lived + 1)


def similarity(memory: Elements, key: Float[Tensor, "k q"], selection: Float[Tensor, "k q"]) -> Float[Tensor, "n q"]:
    """Anisotropic L2: S_ij = -s_i sum_c e_cj (m_ci - q_cj)^2 / sqrt(k), the square written out as matrix products."""
    square = (memory.key.square().T @ selection) - 2 * (memory.key.T @ (selection * key))
    square = square + (selection * key.square()).sum(0)
    return -memory.shrinkage.T * square / math.sqrt(memory.key.shape[0])


def top_softmax(scores: Float[Tensor, "n q"], top_k: int | None) -> Float[Tensor, "n q"]:
    """Softmax over the memory (columns sum to 1), of the `top_k` highest scores alone where that is given."""
    if top_k is None or top_k >= len(scores):
        return scores.softmax(0)
    best, index = scores.topk(top_k, dim=0)
    return torch.zeros_like(scores).scatter(0, index, best.softmax(0))


def consolidated(candidates: Elements, prototypes: int) -> Elements:
    """The most used candidates as prototypes, their values and shrinkages read from all candidates (potentiation)."""
    order = torch.argsort(candidates.usage, descending=True, stable=True)[:prototypes]
    chosen = candidates[order]
    shares = top_softmax(similarity(candidates, chosen.key, chosen.selection), None)
    return Elements.new(chosen.key, candidates.shrinkage @ shares, chosen.selection, candidates.value @ shares)


def without_least_used(elements: Elements, most: int) -> Elements:
    """No more than `most` elements: the least used leave, of equally used ones the older."""
    excess = len(elements) - most
    if excess <= 0:
        return elements
    keep = torch.ones(len(elements), dtype=torch.bool, device=elements.key.device)
    keep[torch.argsort(elements.usage, stable=True)[:excess]] = False
    return elements[keep]


class Memory:
    """What is known of one object while a video runs."""

    def __init__(self, settings: MemorySettings, sensory: Float[Tensor, "1 z h w"]) -> None:
        self.settings = settings
        self.sensory = sensory
        self.working: Elements | None = None
        self.long_term: Elements | None = None

    @property
    def frame_elements(self) -> int:
        """Elements that a frame makes: pixels at stride 16."""
        return self.sensory.shape[-2] * self.sensory.shape[-1]

    @property
    def working_frames(self) -> int:
        return 0 if self.working is None else len(self.working) // self.frame_elements

    def add(self, frame: Elements) -> None:
        """Remember a frame; consolidate when the working memory is full."""
        self.working = frame if self.working is None else self.working.joined(frame)
        if self.working_frames >= self.settings.working_most:
            self._consolidate(self.working)

    def _consolidate(self, working: Elements) -> None:
        """The middle frames become prototypes of the long-term memory; the first and the most recent ones stay."""
        s, n = self.settings, self.frame_elements
        recent = len(working) - (s.working_least - 1) * n
        prototypes = consolidated(working[n:recent], s.prototypes)
        self.working = working[:n].joined(working[recent:])
        if self.long_term is None:
            self.long_term = prototypes
        else:
            kept = without_least_used(self.long_term, s.long_most - len(prototypes))
            self.long_term = kept.joined(prototypes)

    def read(self, key: Float[Tensor, "1 k h w"], selection: Float[Tensor, "1 k h w"]) -> Float[Tensor, "1 v h w"]:
        """The value that all memory together has for each pixel of a query; counts what was used."""
        assert self.working is not None, "read before the first frame was remembered"
        long = self.long_term
        everything = self.working if long is None else long.joined(self.working)
        scores = similarity(everything, key[0].flatten(1), selection[0].flatten(1))
        shares = top_softmax(scores, self.settings.top_k)
        split = 0 if long is None else len(long)
        self.working = self.working.read(shares[split:])
        self.long_term = None if long is None else long.read(shares[:split])
        return (everything.value @ shares).reshape(1, -1, *key.shape[-2:])
