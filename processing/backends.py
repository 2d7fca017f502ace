"""Segmenters and feature matchers by name. Each is imported only when it is chosen: nothing heavy is loaded here.

`Backends` belongs into the pipeline's config; the settings of a stage hold the name and the weights' sha256, never a
path of somebody's machine.
"""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from processing.published_weights import PUBLISHED, find_weights
from recordings.errors import BadInput
from recordings.whole_file import file_sha256

if TYPE_CHECKING:
    from processing.features.sift import FeatureMatcher
    from processing.segment.segmenter import Segmenter

SEGMENTERS = ("background", "xmem")
MATCHERS = ("sift", "loftr", "xfeat", "lightglue")
"""The first one of each is the default and needs no weights."""


@dataclass(frozen=True)
class Backends:
    """Who finds the masks and who matches features; `weights` is the user's folder of learned weights."""

    segmenter: str = SEGMENTERS[0]
    matcher: str = MATCHERS[0]
    weights: Path | None = None


def add_arguments(parser: Any) -> None:
    """`--segmenter NAME --matcher NAME --weights DIR`."""
    parser.add_argument(
        "--segmenter", metavar="NAME", default=SEGMENTERS[0], help=f"masks by one of: {', '.join(SEGMENTERS)}"
    )
    parser.add_argument(
        "--matcher", metavar="NAME", default=MATCHERS[0], help=f"feature matches by one of: {', '.join(MATCHERS)}"
    )
    parser.add_argument("--weights", metavar="DIR", type=Path, help="folder of learned weights; nothing is downloaded")


def chosen(args: Namespace) -> Backends:
    """What was typed, refused where it cannot be had, before anything else is read. Raises BadInput."""
    backends = Backends(args.segmenter, args.matcher, args.weights)
    check(backends)
    return backends


def check(backends: Backends) -> None:
    """Refuse names that are not there, missing weights and missing packages. Raises BadInput."""
    _known("segmenter", backends.segmenter, SEGMENTERS)
    _known("matcher", backends.matcher, MATCHERS)
    for name in (backends.segmenter, backends.matcher):
        if name in PUBLISHED:
            find_weights(PUBLISHED[name], backends.weights)
    if backends.matcher != MATCHERS[0] and find_spec("kornia") is None:
        from processing.features.learned import open_kornia

        open_kornia(PUBLISHED[backends.matcher].option)


def _known(kind: str, name: str, there: tuple[str, ...]) -> None:
    if name not in there:
        raise BadInput(f"there is no {kind} '{name}'; available: {', '.join(there)}")


def settings_of(name: str, backends: Backends) -> dict[str, str]:
    """What a stage's settings must say of a backend: nothing of a default, else its name and its weights' sha256."""
    if name not in PUBLISHED:
        return {}
    return {"backend": name, "weights_sha256": file_sha256(find_weights(PUBLISHED[name], backends.weights))}


def make_segmenter(backends: Backends, background: Segmenter, device: str = "cpu") -> Segmenter:
    """The chosen segmenter. `background` is the default, which others ask for a first mask where none was given."""
    _known("segmenter", backends.segmenter, SEGMENTERS)
    if backends.segmenter == "background":
        return background
    from processing.segment.xmem.segmenter import XMemSegmenter

    return XMemSegmenter.from_weights(backends.weights, finder=background, device=device)


@lru_cache(maxsize=2)
def matcher_of(backends: Backends, device: str) -> FeatureMatcher:
    """The chosen matcher, made once: its weights are loaded when it is first asked for."""
    return make_matcher(backends, device)


def make_matcher(backends: Backends, device: str = "cpu") -> FeatureMatcher:
    """The chosen matcher, with its weights loaded."""
    _known("matcher", backends.matcher, MATCHERS)
    if backends.matcher == "loftr":
        from processing.features.loftr import Loftr

        return Loftr.from_weights(backends.weights, device=device)
    if backends.matcher == "xfeat":
        from processing.features.xfeat import XFeat

        return XFeat.from_weights(backends.weights, device=device)
    if backends.matcher == "lightglue":
        from processing.features.lightglue import LightGlue

        return LightGlue.from_weights(backends.weights, device=device)
    from processing.features.sift import Sift

    return Sift()
