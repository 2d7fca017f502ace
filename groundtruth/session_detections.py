"""What the ground-truth cameras saw in a session: tags with their cameras and times, and whose tags they are."""

from __future__ import annotations

import contextlib
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from calibration.tags.detect import TagDetection, detect_tags
from calibration.tags.faults import explain_absence
from recordings.errors import BadInput
from recordings.mcap.codec import decode_image
from recordings.progress import Progress
from recordings.session import Session, Toss
from recordings.tracks import RigCalibration

CACHE = ".cache/tags"
STILL_PX = 1.5
"""A tag whose centre stays within this over a toss does not move."""
MOVES_PX = 25.0
"""The object moves farther than this in a toss."""
TWICE_PX = 12.0
"""Two detections of one id in one image, farther apart than this, are two tags."""


@dataclass(frozen=True, eq=False)
class TagSeen:
    """One tag in one image of a toss. `time_ns` is the mid-exposure on the D455's clock."""

    toss: int
    camera: str
    time_ns: int
    tag: TagDetection


@dataclass(frozen=True, eq=False)
class Detections:
    """Everything seen. `frames[toss][camera]`: times of all images, with or without tags. `twice`: ids seen twice in
    one image, and in how many. `lost_images`: on which the detector died."""

    seen: tuple[TagSeen, ...]
    frames: Mapping[int, Mapping[str, Array]]
    twice: Mapping[int, int]
    lost_images: int


def mono_cameras(toss: Toss) -> tuple[str, ...]:
    """Cameras with grey images in a toss."""
    return tuple(name for name in toss.cameras() if f"/{name}/image" in toss.file.channels)


def find_tags(
    session: Session,
    tosses: Sequence[int],
    family: str,
    offset_ns: int,
    progress: Progress,
) -> Detections:
    """Detect tags in all mono images, cached beside the session. `offset_ns` is added to their stamps.

    Raises BadInput where there is no image or no tag.
    """
    frames: dict[int, dict[str, Array]] = {}
    for number in tosses:
        toss = session.toss(number)
        frames[number] = {name: toss.mono(name).times_ns + offset_ns for name in mono_cameras(toss)}
    counts = [(toss, camera, len(times)) for toss, cameras in frames.items() for camera, times in cameras.items()]
    total = sum(n for *_, n in counts)
    if total == 0:
        raise BadInput(
            f"{session.path} has no images of ground-truth cameras (/mono0/image, …) in toss "
            f"{', '.join(map(str, tosses))}; record with mono cameras, or bring truth in: "
            "`toss-session import folder DIR OUT --truth TRUTH_DIR`"
        )
    cache = session.path / CACHE if session.path.is_dir() else None
    lists = detect_tags(_images(session, counts), family, _writable(cache), progress, total=total)
    if not any(lists):
        raise BadInput(_no_tags(session, counts, family, total))
    every = iter(lists)
    seen = [
        TagSeen(toss, camera, int(time_ns), tag)
        for toss, camera, _ in counts
        for time_ns in frames[toss][camera]
        for tag in next(every)
    ]
    kept, twice = _single(seen)
    return Detections(tuple(kept), frames, twice, len(lists.lost))


def _images(session: Session, counts: Sequence[tuple[str | int, str, int]]) -> Iterator[UInt8[Array, "h w"]]:
    for toss, camera, _ in counts:
        for frame in session.toss(int(toss)).mono(camera):
            image: Array = decode_image(frame)
            yield image if image.ndim == 2 else np.ascontiguousarray(image[..., 1])


def _writable(cache: Path | None) -> Path | None:
    """The cache's folder, or None where the session cannot be written to."""
    if cache is not None:
        with contextlib.suppress(OSError):
            cache.mkdir(parents=True, exist_ok=True)
            return cache
    return None


def _single(seen: Sequence[TagSeen]) -> tuple[list[TagSeen], dict[int, int]]:
    """Of an id that one image shows twice at different places neither is kept: nobody knows which is which."""
    groups: dict[tuple[int, str, int, int], list[TagSeen]] = defaultdict(list)
    for s in seen:
        groups[(s.toss, s.camera, s.time_ns, s.tag.tag_id)].append(s)
    kept, twice = [], Counter[int]()
    for (*_, tag_id), group in groups.items():
        centers = np.array([s.tag.corners_px.mean(axis=0) for s in group])
        if len(group) > 1 and np.linalg.norm(centers - centers[0], axis=1).max() > TWICE_PX:
            twice[tag_id] += 1
        else:
            kept.append(max(group, key=lambda s: s.tag.decision_margin))
    return kept, dict(twice)


def _no_tags(session: Session, counts: Sequence[tuple[int, str, int]], family: str, total: int) -> str:
    """Why there may be none: another family, or mirrored images, are looked for in a few of them."""
    cameras = ", ".join(sorted({camera for _, camera, _ in counts}))
    few = [image for k, image in enumerate(_images(session, counts)) if k % max(1, total // 6) == 0]
    return (
        f"no tag of {family} in {total} images of {cameras}: {explain_absence(few, family)}. Look at them with "
        f"`toss-view {session.path}`; another family is given by `--family`"
    )


@dataclass(frozen=True, eq=False)
class Roles:
    """Whose tag each id is: `table` (known place), `still` (unknown place, not moving), `body` (the tossed object)."""

    table: frozenset[int]
    still: frozenset[int]
    body: frozenset[int]


def assign_roles(
    detections: Detections, calibration: RigCalibration, ignored: frozenset[int], layout: Mapping[int, Array] | None
) -> Roles:
    """Table tags are the calibration's; of the others those that move in the images are the object's.

    Raises BadInput for an id that is on two bodies, or when nothing moves.
    """
    known = frozenset(t.tag_id for t in calibration.table_tags)
    if layout is not None and known & set(layout):
        both = sorted(known & set(layout))
        raise BadInput(
            f"tag {both[0]} is on two bodies, the table (calibration.json) and the object (the given layout); "
            "wanted every id once: print another one, or correct the files"
        )
    often = {i: n for i, n in detections.twice.items() if n > 2}
    if often:
        raise BadInput(
            f"tag {min(often)} is seen twice in one image, {often[min(often)]} times: it is on two bodies, or "
            f"printed twice; wanted every id once. Cover one of them, or leave it out: `--ignore {min(often)}`"
        )
    moving, staying = _moved(detections)
    suspicious = sorted(moving & known - ignored)
    if suspicious:
        raise BadInput(
            f"tag {suspicious[0]} moves in the images, yet calibration.json has it on the table: it is on two bodies, "
            f"or the table's list is wrong; leave it out with `--ignore {suspicious[0]}`, or correct calibration.json"
        )
    ids = {s.tag.tag_id for s in detections.seen} - ignored - known
    body = frozenset(layout) & ids if layout is not None else frozenset(ids & moving)
    if not body:
        raise BadInput(
            f"no tag moves in these tosses: of {sorted({s.tag.tag_id for s in detections.seen})} none is on a tossed "
            "object; wanted tags on it, in view of the mono cameras while it flies"
        )
    return Roles(known - ignored, frozenset(ids & staying - body), body)


def _moved(detections: Detections) -> tuple[frozenset[int], frozenset[int]]:
    """Ids whose centre wanders over some toss in some camera, and ids seen often that stay in all."""
    centers: dict[tuple[int, int, str], list[Float[Array, "2"]]] = defaultdict(list)
    for s in detections.seen:
        centers[(s.tag.tag_id, s.toss, s.camera)].append(s.tag.corners_px.mean(axis=0))
    reach: dict[int, float] = defaultdict(float)
    most: dict[int, int] = defaultdict(int)
    for (tag_id, *_), group in centers.items():
        points = np.array(group)
        reach[tag_id] = max(reach[tag_id], float(np.percentile(np.ptp(points, axis=0), 100)))
        most[tag_id] = max(most[tag_id], len(points))
    moving = frozenset(i for i, r in reach.items() if r > MOVES_PX)
    return moving, frozenset(i for i, r in reach.items() if r < STILL_PX and most[i] >= 5)


def shared_times(detections: Detections, within_ns: int) -> tuple[Detections, int]:
    """Times of different cameras that are nearer than `within_ns` made equal (to the earliest), and the largest spread
    (ns) of those that were: triggered cameras share an instant, others keep their own."""
    moved: dict[tuple[int, int], int] = {}
    spread = 0
    for toss, cameras in detections.frames.items():
        times = np.unique(np.concatenate(list(cameras.values()))) if cameras else np.zeros(0, np.int64)
        start = None
        for t in times.tolist():
            if start is None or t - start > within_ns:
                start = t
            spread = max(spread, t - start)
            moved[(toss, t)] = start
    seen = tuple(replace(s, time_ns=moved[(s.toss, s.time_ns)]) for s in detections.seen)
    frames = {
        toss: {
            name: np.array([moved[(toss, int(t))] for t in times], dtype=np.int64) for name, times in cameras.items()
        }
        for toss, cameras in detections.frames.items()
    }
    return replace(detections, seen=seen, frames=frames), spread


@dataclass(frozen=True, eq=False)
class Measured:
    """One tag at one instant, triangulated between cameras of known place: its mean edge, and that in the images."""

    tag_id: int
    edge_m: float
    edge_px: float


def triangulated_tags(detections: Detections, calibration: RigCalibration) -> list[Measured]:
    """Every tag that two or more cameras of known place saw at an instant."""
    groups: dict[tuple[int, int, int], list[TagSeen]] = defaultdict(list)
    for s in detections.seen:
        groups[(s.toss, s.time_ns, s.tag.tag_id)].append(s)
    found = []
    for (*_, tag_id), group in groups.items():
        rays = [r for r in (_world_rays(calibration, s) for s in group) if r is not None]
        if len(rays) >= 2:
            edge_px = float(np.mean([_edge(s.tag.corners_px) for s in group]))
            found.append(Measured(tag_id, _edge(_triangulated(rays)), edge_px))
    return found


def _edge(corners: Float[Array, "4 d"]) -> float:
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())


def measured_sizes_m(measured: Sequence[Measured], ids: frozenset[int]) -> dict[int, tuple[float, int]]:
    """Side of each tag and from how many instants."""
    edges: dict[int, list[float]] = defaultdict(list)
    for m in measured:
        if m.tag_id in ids:
            edges[m.tag_id].append(m.edge_m)
    return {i: (float(np.median(e)), len(e)) for i, e in edges.items()}


def shrink_px(measured: Sequence[Measured], sizes_m: Mapping[int, float], least: int = 10) -> float:
    """By how many pixels every tag's edge is too short in the images: light spills over dark squares, and blur rounds
    corners. The median over tags of known size; 0 where there are too few, or it is no such effect (above 1 px)."""
    short = [m.edge_px * (1 - m.edge_m / sizes_m[m.tag_id]) for m in measured if m.tag_id in sizes_m]
    value = float(np.median(short)) if len(short) >= least else 0.0
    return value if abs(value) < 1.0 else 0.0


def enlarged(detections: Detections, by_px: float) -> Detections:
    """All tags' edges lengthened by this many pixels about their middles."""

    def larger(s: TagSeen) -> TagSeen:
        corners = s.tag.corners_px
        center = corners.mean(axis=0)
        return replace(s, tag=replace(s.tag, corners_px=center + (corners - center) * (1 + by_px / _edge(corners))))

    return replace(detections, seen=tuple(larger(s) for s in detections.seen))


def _world_rays(calibration: RigCalibration, s: TagSeen) -> tuple[Float[Array, "3"], Float[Array, "4 3"]] | None:
    """The camera's place and unit rays through a tag's corners, in the world; None where its place is not known."""
    model = calibration.cameras.get(s.camera)
    world = calibration.find("world", model.frame) if model is not None else None
    if model is None or world is None:
        return None
    rays = world.vectors(model.rays(s.tag.corners_px))
    return world.translation_m, rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _triangulated(rays: Sequence[tuple[Float[Array, "3"], Float[Array, "4 3"]]]) -> Float[Array, "4 3"]:
    """Points nearest to the rays of all cameras: sum of (I - d d') (x - o) vanishes."""
    out = np.empty((4, 3))
    for corner in range(4):
        across = [np.eye(3) - np.outer(d[corner], d[corner]) for _, d in rays]
        pulled = [A @ o for A, (o, _) in zip(across, rays, strict=True)]
        out[corner] = np.linalg.solve(np.sum(across, axis=0), np.sum(pulled, axis=0))
    return out
