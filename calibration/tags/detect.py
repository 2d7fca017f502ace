"""AprilTags in images: found by pupil-apriltags in processes of its own, moved to OpenCV's pixels, refined under blur.

found = detect_tags((frame.image for frame in frames), cache=folder)
found[0][0].corners_px                      # of the first tag in the first image
"""

from __future__ import annotations

import hashlib
import os
import queue
import struct
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from calibration.tags.detector_process import COUNT, HEADER, TAG_VALUES
from calibration.tags.edges import refine_corners
from calibration.tags.pattern import refine_by_pattern
from recordings.bounded.limits import open_npz
from recordings.errors import BadInput, TosslabError
from recordings.progress import Progress, Silent

FAMILY_CELLS = {"tag36h11": 8, "tag25h9": 7, "tag16h5": 6, "tagStandard41h12": 5}
"""Side of the square whose corners the detector gives, in cells. (Families with tens of thousands of codes take minutes
and gigabytes to load: they are left out.)"""
Response = Literal["linear", "srgb"]
Search = Literal["normal", "thorough"]
"""`thorough` looks in the image enlarged twice too: tags down to some 10 px, at five times the time."""
Refinement = Literal["edges", "pattern"]
"""`pattern` fits the whole tag where its family's patterns are known (and the edges where that fails): half the
error on a board that stands still, at some 5 ms a tag."""
PUPIL_SHIFT_PX = 0.5
"""The detector counts a pixel's centre as half, OpenCV as whole numbers."""
CHUNK = 64
VERSION = 2
UNREFINED_SIGMA_PX = 0.6
LARGE_IMAGE_PX = 1_000_000
"""Images above this many pixels are searched at half size; corners are refined in the whole image."""


class DetectorDied(TosslabError):
    """The process with pupil-apriltags cannot be started."""


@dataclass(frozen=True, eq=False)
class TagDetection:
    """One AprilTag in one image. `corners_px` in OpenCV's pixels (centre of the first pixel at 0), in the order of
    pupil-apriltags: in the tag's frame (x right, y down, z into the paper) (-,+), (+,+), (+,-), (-,-).

    `covariance_px2` is each corner's own; `refined` is False where the edges could not be fitted (the detector's own
    corners then, with a wide covariance).
    """

    tag_id: int
    corners_px: Float[Array, "4 2"]
    covariance_px2: Float[Array, "4 2 2"]
    decision_margin: float
    hamming: int
    refined: bool = True

    @property
    def sigma_px(self) -> float:
        """Root mean variance of a corner's coordinate."""
        return float(np.sqrt(np.einsum("kii->k", self.covariance_px2).mean() / 2))


class TagLists(list[list[TagDetection]]):
    """The tags of every image, in the images' order. `lost`: positions of images on which the detector died twice;
    they are empty here."""

    def __init__(self, lists: Iterable[list[TagDetection]], lost: Sequence[int] = ()) -> None:
        super().__init__(lists)
        self.lost = tuple(lost)


def detect_tags(
    images: Iterable[UInt8[Array, "h w"]],
    family: str = "tag36h11",
    cache: Path | None = None,
    progress: Progress | None = None,
    *,
    response: Response = "linear",
    total: int | None = None,
    jobs: int | None = None,
    largest_hamming: int = 1,
    search: Search = "normal",
    refinement: Refinement = "edges",
) -> TagLists:
    """All tags of `family` in grey images.

    `response`: how the camera turns light into numbers; in `srgb` pictures edges would seem moved inwards by a third
    of a pixel, so they are fitted in linear light. `cache`: a folder where results are kept by the images' content, 64
    images a file. `total`: how many images there are, for progress. Images on which the detector dies are tried once
    more in a fresh process, then left empty and listed in `.lost`.
    """
    settings = _Settings(family, response, largest_hamming, search, refinement)
    done, progress = 0, progress or Silent()
    lists: list[list[TagDetection]] = []
    lost: list[int] = []
    with _detectors(settings, jobs or min(2, os.cpu_count() or 1)) as pool:
        for chunk in _chunks(images):
            found, dead = _cached(chunk, settings, cache, pool)
            lost += [done + k for k in dead]
            lists += found
            done += len(chunk)
            progress.step(done, max(total or done, done), "images searched for tags")
    return TagLists(lists, lost)


@dataclass(frozen=True)
class _Settings:
    family: str
    response: Response
    largest_hamming: int
    search: Search = "normal"
    refinement: Refinement = "edges"

    def __post_init__(self) -> None:
        if self.family not in FAMILY_CELLS:
            raise BadInput(f"unknown tag family '{self.family}'; wanted one of {', '.join(FAMILY_CELLS)}")

    def key(self, images: Sequence[UInt8[Array, "h w"]]) -> str:
        digest = hashlib.sha256(f"{VERSION} {self}".encode())
        for image in images:
            digest.update(struct.pack("<ii", *image.shape))
            digest.update(np.ascontiguousarray(image).data)
        return digest.hexdigest()[:20]


def _chunks(images: Iterable[UInt8[Array, "h w"]]) -> Iterator[list[UInt8[Array, "h w"]]]:
    source = iter(images)
    while chunk := list(islice(source, CHUNK)):
        for image in chunk:
            if image.ndim != 2 or image.dtype != np.uint8:
                raise BadInput(f"tags are looked for in grey 8-bit images; found shape {image.shape}, {image.dtype}")
        yield chunk


def _cached(
    chunk: list[UInt8[Array, "h w"]], settings: _Settings, cache: Path | None, pool: _Pool
) -> tuple[list[list[TagDetection]], list[int]]:
    path = cache / f"tags-{settings.key(chunk)}.npz" if cache else None
    if path is not None and (kept := _read(path, len(chunk))) is not None:
        return kept, []
    answers = pool.map(chunk)
    found = [[] if tags is None else tags for tags in answers]
    lost = [k for k, tags in enumerate(answers) if tags is None]
    if path is not None and not lost:
        _write(path, found)
    return found, lost


def _write(path: Path, lists: Sequence[Sequence[TagDetection]]) -> None:
    tags = [t for tags in lists for t in tags]
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
    with open(partial, "wb") as out:
        np.savez(
            out,
            image=np.repeat(np.arange(len(lists)), [len(tags) for tags in lists]),
            about=np.array([[t.tag_id, t.hamming, t.refined] for t in tags], np.int64).reshape(-1, 3),
            margin=np.array([t.decision_margin for t in tags], np.float64),
            corners_px=np.array([t.corners_px for t in tags], np.float64).reshape(-1, 4, 2),
            covariance_px2=np.array([t.covariance_px2 for t in tags], np.float64).reshape(-1, 4, 2, 2),
        )
    partial.replace(path)


def _read(path: Path, images: int) -> list[list[TagDetection]] | None:
    """None where nothing is kept, or what is kept cannot be read (it is then made anew)."""
    try:
        with open_npz(path) as kept:
            data = {name: kept[name] for name in kept.files}
        lists: list[list[TagDetection]] = [[] for _ in range(images)]
        for k, image in enumerate(data["image"].tolist()):
            tag_id, hamming, refined = data["about"][k].tolist()
            corners, covariance = data["corners_px"][k], data["covariance_px2"][k]
            margin = float(data["margin"][k])
            lists[image].append(TagDetection(tag_id, corners, covariance, margin, hamming, bool(refined)))
        return lists
    except (OSError, ValueError, KeyError, IndexError):
        return None


class DetectorChild:
    """A process with one detector for images of one kind. `detect` raises DetectorDied when it does not answer."""

    def __init__(self, family: str, decimate: float) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "calibration.tags.detector_process", family, str(decimate)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(p for p in sys.path if p)},
        )

    def detect(self, image: UInt8[Array, "h w"]) -> Float[Array, "n 11"]:
        """Rows id, hamming, decision margin, four corners x, y (the detector's pixels)."""
        asked, answered = self._process.stdin, self._process.stdout
        assert asked is not None
        assert answered is not None
        try:
            asked.write(HEADER.pack(*image.shape))
            asked.write(np.ascontiguousarray(image).data)
            asked.flush()
            head = answered.read(COUNT.size)
            size = COUNT.unpack(head)[0] * TAG_VALUES * 8 if len(head) == COUNT.size else -1
            body = answered.read(size) if size >= 0 else b""
        except (BrokenPipeError, ConnectionError) as gone:
            raise DetectorDied("the tag detector's process ended") from gone
        if size < 0 or len(body) < size:
            raise DetectorDied(f"the tag detector's process ended (code {self._process.wait()})")
        return np.frombuffer(body, np.float64).reshape(-1, TAG_VALUES)

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                try:
                    pipe.close()
                except BrokenPipeError:
                    pass


class _Pool:
    """Some children, each used by one thread at a time; a dead one is replaced."""

    def __init__(self, settings: _Settings, jobs: int) -> None:
        self._settings = settings
        self._idle: queue.SimpleQueue[dict[float, DetectorChild]] = queue.SimpleQueue()
        for _ in range(jobs):
            self._idle.put({})
        self._threads = ThreadPoolExecutor(jobs)
        self._jobs = jobs

    def map(self, images: Sequence[UInt8[Array, "h w"]]) -> list[list[TagDetection] | None]:
        return list(self._threads.map(self._tags, images))

    def _tags(self, image: UInt8[Array, "h w"]) -> list[TagDetection] | None:
        children = self._idle.get()
        try:
            rows = self._rows(image, children)
        finally:
            self._idle.put(children)
        return None if rows is None else detections(image, rows, self._settings)

    def _rows(self, image: UInt8[Array, "h w"], children: dict[float, DetectorChild]) -> Float[Array, "n 11"] | None:
        if self._settings.search == "thorough":
            plain = self._ask(image, 1.0, children)
            large = self._ask(cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC), 1.0, children)
            return None if plain is None or large is None else _with_small_ones(plain, large)
        return self._ask(image, 2.0 if image.size > LARGE_IMAGE_PX else 1.0, children)

    def _ask(
        self, image: UInt8[Array, "h w"], decimate: float, children: dict[float, DetectorChild]
    ) -> Float[Array, "n 11"] | None:
        for _ in range(2):
            if decimate not in children:
                children[decimate] = DetectorChild(self._settings.family, decimate)
            try:
                return children[decimate].detect(image)
            except DetectorDied:
                children.pop(decimate).close()
        return None

    def close(self) -> None:
        self._threads.shutdown(wait=True, cancel_futures=True)
        for _ in range(self._jobs):
            for child in self._idle.get().values():
                child.close()


def _with_small_ones(plain: Float[Array, "n 11"], large: Float[Array, "m 11"]) -> Float[Array, "k 11"]:
    """The tags of an image, and those that were found only in the image enlarged twice."""
    halved = np.hstack([large[:, :3], large[:, 3:] / 2])  # both count a pixel's centre as half
    middles, others = (r[:, 3:].reshape(-1, 4, 2).mean(axis=1) for r in (plain, halved))
    gaps = np.linalg.norm(others[:, None] - middles, axis=2).min(axis=1, initial=np.inf)
    sides = np.linalg.norm(halved[:, 3:5] - halved[:, 5:7], axis=1)
    return np.vstack([plain, halved[gaps > 0.5 * sides]])


@contextmanager
def _detectors(settings: _Settings, jobs: int) -> Iterator[_Pool]:
    pool = _Pool(settings, jobs)
    try:
        yield pool
    finally:
        pool.close()


def detections(image: UInt8[Array, "h w"], rows: Float[Array, "n 11"], settings: _Settings) -> list[TagDetection]:
    """The detector's answers in OpenCV's pixels, edges fitted in linear light."""
    rows = rows[rows[:, 1] <= settings.largest_hamming]
    corners = rows[:, 3:].reshape(-1, 4, 2) - PUPIL_SHIFT_PX
    light = _LINEAR[image] if settings.response == "srgb" else image.astype(np.float32)
    refined, covariance, fitted = refine_corners(light, corners, FAMILY_CELLS[settings.family])
    if settings.refinement == "pattern":
        ids = rows[:, 0].astype(int).tolist()
        better, spread, fine = refine_by_pattern(light, refined, ids, settings.family)
        refined[fine], covariance[fine], fitted = better[fine], spread[fine], fitted | fine
    wide = np.tile(UNREFINED_SIGMA_PX**2 * np.eye(2), (4, 1, 1))
    return [
        TagDetection(
            int(row[0]), refined[k], covariance[k] if fitted[k] else wide, row[2], int(row[1]), bool(fitted[k])
        )
        for k, row in enumerate(rows)
    ]


def _srgb_table() -> Float[Array, "256"]:
    """IEC 61966-2-1, scaled so that white stays 255."""
    v = np.arange(256) / 255.0
    linear = np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)
    return (255.0 * linear).astype(np.float32)


_LINEAR = _srgb_table()
