"""What is wrong when tags are not found, have another size than stated, or do not move together."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from calibration.cameras.poses import inverse_poses
from calibration.report import Finding
from calibration.tags.detect import FAMILY_CELLS, TagDetection, detect_tags
from recordings.geometry import CameraModel

LOOKED_AT = 6
SURE_MARGIN = 30.0
LEAST_FOUND = 2
SIZE_OFF = 0.015
LEAST_ANGLE_COS = np.cos(np.radians(5.0))


def explain_absence(images: Sequence[UInt8[Array, "h w"]], family: str) -> str:
    """Why no tag of `family` is in these images, in words: another family, mirrored pictures, or nothing at all."""
    some = [images[k] for k in np.unique(np.linspace(0, len(images) - 1, LOOKED_AT).astype(int))] if len(images) else []
    if not some:
        return "no images at all"
    for other in (f for f in FAMILY_CELLS if f != family):
        ids = _sure_ids(some, other)
        if len(ids) >= LEAST_FOUND:
            return f"no {family} tags, but tags of the family {other} (ids {_listed(ids)}): state that family"
    mirrored = _sure_ids([np.ascontiguousarray(image[:, ::-1]) for image in some], family)
    if len(mirrored) >= LEAST_FOUND:
        return f"the pictures are mirrored: turned over they show {family} tags {_listed(mirrored)}; unflip the camera"
    dark = np.mean([image.mean() for image in some])
    hint = f" (the pictures are dark: mean level {dark:.0f} of 255)" if dark < 25 else ""
    return f"no tags of any family in {len(some)} of {len(images)} images{hint}: check exposure, focus and view"


def _sure_ids(images: Sequence[UInt8[Array, "h w"]], family: str) -> list[int]:
    """Ids read without a corrected bit, twice or more."""
    lists = detect_tags(images, family, largest_hamming=0)
    ids = [t.tag_id for tags in lists for t in tags if t.decision_margin > SURE_MARGIN]
    return sorted({i for i in ids if ids.count(i) >= 1}) if len(ids) >= LEAST_FOUND else []


def _listed(ids: Sequence[int]) -> str:
    return ", ".join(map(str, ids[:8])) + (", ..." if len(ids) > 8 else "")


def sizes_by_triangulation(
    models: Mapping[str, CameraModel],
    camera_from_rig: Mapping[str, Float[Array, "4 4"]],
    detections: Mapping[str, Sequence[Sequence[TagDetection]]],
) -> dict[int, tuple[float, int]]:
    """Side of each tag in m by calibrated cameras that see it at the same instant (median over sides and instants), and
    how many sights that is."""
    sides: dict[int, list[float]] = {}
    for a, b in combinations([n for n in models if n in camera_from_rig and n in detections], 2):
        for tags_a, tags_b in zip(detections[a], detections[b]):
            other = {t.tag_id: t for t in tags_b}
            for tag in tags_a:
                if tag.tag_id in other:
                    pair = ((models[a], camera_from_rig[a], tag), (models[b], camera_from_rig[b], other[tag.tag_id]))
                    corners = _triangulated(*pair)
                    if corners is not None:
                        lengths = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
                        sides.setdefault(tag.tag_id, []).append(float(np.median(lengths)))
    return {tag: (float(np.median(values)), len(values)) for tag, values in sorted(sides.items())}


Look = tuple[CameraModel, Array, TagDetection]


def _triangulated(first: Look, second: Look) -> Float[Array, "4 3"] | None:
    """Nearest points of the rays, in the rig; None where they are nearly parallel."""
    origins, rays = [], []
    for model, pose, tag in (first, second):
        back = inverse_poses(pose)
        direction = model.rays(tag.corners_px) @ back[:3, :3].T
        rays.append(direction / np.linalg.norm(direction, axis=1, keepdims=True))
        origins.append(back[:3, 3])
    cosine = np.einsum("ij,ij->i", *rays)
    if not np.isfinite(cosine).all() or np.abs(cosine).max() > LEAST_ANGLE_COS:
        return None
    gap = origins[1] - origins[0]
    along_a, along_b = rays[0] @ gap, rays[1] @ gap
    s = (along_a - cosine * along_b) / (1 - cosine**2)
    t = (cosine * along_a - along_b) / (1 - cosine**2)
    return (origins[0] + s[:, None] * rays[0] + origins[1] + t[:, None] * rays[1]) / 2


def wrong_sizes(
    given_m: Mapping[int, float], measured: Mapping[int, tuple[float, int]], sights: int = 5
) -> list[Finding]:
    """Tags whose size is not as stated, by the ratio that calibrated cameras measure; one sentence when all are."""
    ratios = {i: m / given_m[i] for i, (m, n) in measured.items() if i in given_m and n >= sights}
    if not ratios:
        return []
    common = float(np.median(list(ratios.values())))
    found = []
    if abs(common - 1) > SIZE_OFF:
        size = common * float(np.median([given_m[i] for i in ratios]))
        found.append(
            Finding(
                "refused",
                f"wrong tag size: the tags measure {common:.3f} of what is stated; state {1e3 * size:.2f} mm",
            )
        )
    for tag, ratio in ratios.items():
        if abs(ratio / common - 1) > 2 * SIZE_OFF:
            text = f"tag {tag} measures {ratio:.3f} of its stated size, the others {common:.3f}"
            found.append(Finding("warning", f"{text}: its size is wrong, or it is another tag of this id"))
    return found
