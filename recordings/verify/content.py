"""What the messages of a toss's file say, held against physics and each other. The bytes were checked before."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int64
from numpy import ndarray as Array

from recordings import sync
from recordings.bounded import limits
from recordings.errors import TosslabError
from recordings.geometry import CameraModel
from recordings.given_masks import GivenMasks
from recordings.mcap import codec
from recordings.mcap.structure import Finding, Severity, TopicSeen
from recordings.records import DepthImage, EncodedImage
from recordings.session import PAIR_WITHIN_PERIODS, Toss

UNITS_M = (0.001, 0.00025, 0.0001)
"""Units that depth cameras are set to."""
PLAUSIBLE_DEPTH_M = (0.15, 3.0)
LOOKED_AT = 5
"""Images of a stream that are decoded; their sizes and depths stand for all."""
LOOKED_AT_PIXELS = 1_000_000_000
"""Of all images and masks of a toss."""
WRAP_US_NS = (1 << 32) * 1000
NUMBERED = ("color", "image", "depth", "joint_states")


@dataclass(frozen=True)
class Plausibility:
    """How measured depth relates to the table plane: `ratio` is their median quotient over the pixels that see it."""

    ratio: float
    pixels: int


def check_content(toss: Toss, topics: dict[str, TopicSeen], place: str) -> list[Finding]:
    """Findings about stamps, frame numbers, images, depth, masks and intrinsics of one toss."""
    return list(_Content(toss, topics, place).run())


class _Content:
    def __init__(self, toss: Toss, topics: dict[str, TopicSeen], place: str) -> None:
        self.toss, self.topics, self.place = toss, topics, place
        self.pixels_left = LOOKED_AT_PIXELS

    def run(self) -> Iterator[Finding]:
        for topic, seen in sorted(self.topics.items()):
            if topic.rsplit("/", 1)[-1] in NUMBERED:
                yield from self._stamps(topic, seen)
                yield from self._numbers(topic, seen)
        for camera in self.toss.cameras():
            yield from self._camera(camera)
        yield from self._masks()
        if self.pixels_left < 0:
            text = f"its images are so many and so large that not all were decoded; {LOOKED_AT_PIXELS} pixels were"
            yield self._finding("warning", text)

    def _finding(self, severity: Severity, text: str) -> Finding:
        return Finding(severity, self.place, text)

    def _stamps(self, topic: str, seen: TopicSeen) -> Iterator[Finding]:
        steps = np.diff(np.array(seen.publish_ns, dtype=np.uint64).astype(np.int64))
        for kind, where in (("repeat", np.flatnonzero(steps == 0)), ("go back", np.flatnonzero(steps < 0))):
            if len(where) == 0:
                continue
            step_ns = int(steps[where[0]])
            wrapped = abs(abs(step_ns) - WRAP_US_NS) < 0.1 * WRAP_US_NS
            why = " (a 32-bit microsecond clock wrapped round)" if wrapped else ""
            first = f"first after message {where[0]} by {-step_ns / 1e9:g} s"
            text = f"{topic}: stamps {kind} {len(where)} times, {first}{why}"
            yield self._finding("error", text)

    def _numbers(self, topic: str, seen: TopicSeen) -> Iterator[Finding]:
        """Frame numbers against themselves and against the stamps."""
        numbers = np.array(seen.sequence, dtype=np.int64)
        times_ns = np.array(seen.publish_ns, dtype=np.uint64).astype(np.int64)
        if len(numbers) < 3:
            return
        steps = np.diff(numbers) % (1 << 32)
        missing = steps - 1
        if (steps == 0).any() or (steps > 1 << 31).any():
            count = int(((steps == 0) | (steps > 1 << 31)).sum())
            yield self._finding("warning", f"{topic}: frame numbers repeat or go back {count} times")
        elif missing.any():
            lost, places = int(missing.sum()), int((missing > 0).sum())
            yield self._finding("warning", f"{topic}: {lost} frame numbers missing at {places} places{_first(missing)}")
        yield from self._gaps(topic, times_ns, steps)

    def _gaps(self, topic: str, times_ns: Int64[Array, " n"], steps: Int64[Array, " m"]) -> Iterator[Finding]:
        period_ns = sync.frame_period_ns(times_ns)
        if not period_ns or period_ns < 0:
            return
        gaps = sync.gaps(times_ns, period_ns)
        silent = [(i, n) for i, n in gaps if steps[i] == 1]
        if silent:
            at_s = (times_ns[silent[0][0]] - times_ns[0]) / 1e9
            text = (
                f"{topic}: {len(silent)} gaps in the stamps, {sum(n for _, n in silent)} frames of "
                f"{period_ns / 1e6:.2f} ms, first at {at_s:.3f} s; the frame numbers do not show them"
            )
            yield self._finding("warning", text)
        bridged = int(((steps > 1) & (steps < 1 << 31) & (np.diff(times_ns) < 1.5 * period_ns)).sum())
        if bridged:
            yield self._finding("warning", f"{topic}: {bridged} jumps of the frame number without a gap in the stamps")

    def _camera(self, camera: str) -> Iterator[Finding]:
        model = self.toss.calibration.cameras.get(camera)
        if model is None:
            yield self._finding("warning", f"{camera}: no intrinsics in the calibration")
        else:
            yield from self._intrinsics(camera, model)
        for topic, frames in (
            (f"/{camera}/color", self.toss.color(camera)),
            (f"/{camera}/image", self.toss.mono(camera)),
        ):
            for i in _sampled(len(frames)):
                if not self._may_look(frames[i].width * frames[i].height):
                    return
                try:
                    pixels = codec.decode_image(frames[i])
                except TosslabError as wrong:
                    yield self._finding("error", f"{topic}: {wrong}")
                    break
                if model is not None and pixels.shape[:2] != (model.height, model.width):
                    text = (
                        f"{topic}: images of {pixels.shape[1]}x{pixels.shape[0]}, "
                        f"intrinsics of {model.width}x{model.height}"
                    )
                    yield self._finding("error", text)
                    break
        if f"/{camera}/color" in self.topics:
            yield from self._depth(camera, model)

    def _intrinsics(self, camera: str, model: CameraModel) -> Iterator[Finding]:
        off_x, off_y = abs(model.cx / (model.width - 1) - 0.5), abs(model.cy / (model.height - 1) - 0.5)
        if max(off_x, off_y) > 0.2:
            text = (
                f"{camera}: the principal point ({model.cx:.1f}, {model.cy:.1f}) lies far from the middle of "
                f"{model.width}x{model.height}"
            )
            yield self._finding("warning", text)
        width_deg = 2 * np.degrees(np.arctan(model.width / 2 / model.fx))
        if not 15 < width_deg < 150 or not 0.8 < model.fx / model.fy < 1.25:
            text = f"{camera}: focal lengths {model.fx:.1f}, {model.fy:.1f} px see {width_deg:.0f} deg: not plausible"
            yield self._finding("warning", text)

    def _depth(self, camera: str, model: CameraModel | None) -> Iterator[Finding]:
        depths, colors = self.toss.depth(camera), self.toss.color(camera)
        if len(depths) == 0:
            yield self._finding("warning", f"{camera}: colour without any depth")
            return
        yield from self._pairs(camera, colors.times_ns, depths.times_ns)
        try:
            images = [depths[i] for i in _sampled(len(depths))]
        except TosslabError as wrong:
            yield self._finding("error", f"/{camera}/depth: {wrong}")
            return
        yield from self._alignment(camera, model, images[0])
        yield from self._unit(camera, images)

    def _pairs(self, camera: str, color_ns: Int64[Array, " n"], depth_ns: Int64[Array, " m"]) -> Iterator[Finding]:
        period_ns = sync.frame_period_ns(color_ns) or 33_333_333
        pairs = sync.pair_nearest(color_ns, depth_ns, int(PAIR_WITHIN_PERIODS * period_ns))
        alone = int((pairs == sync.UNPAIRED).sum())
        unused = len(depth_ns) - (len(color_ns) - alone)
        if alone or unused:
            text = (
                f"{camera}: {len(color_ns)} colour and {len(depth_ns)} depth images; {alone} colour images have no "
                f"depth near enough in time, {unused} depth images no colour"
            )
            yield self._finding("warning", text)

    def _alignment(self, camera: str, model: CameraModel | None, depth: DepthImage) -> Iterator[Finding]:
        calibration = self.toss.calibration
        lens = calibration.cameras.get(f"{camera}_depth")
        height, width = depth.raw.shape
        if lens is not None:
            if model is not None and calibration.find(model.frame, lens.frame) is None:
                text = (
                    f"{camera}: depth is not aligned to colour and the calibration has no transform between "
                    f"'{model.frame}' and '{lens.frame}': it cannot be aligned"
                )
                yield self._finding("error", text)
            else:
                yield self._finding("info", f"{camera}: depth is not aligned to colour; it is aligned when read")
            if (lens.width, lens.height) != (width, height):
                yield self._finding(
                    "error", f"/{camera}/depth: images of {width}x{height}, intrinsics of {lens.width}x{lens.height}"
                )
        elif model is not None and (model.width, model.height) != (width, height):
            text = (
                f"{camera}: depth is {width}x{height}, colour {model.width}x{model.height}, and the calibration has no "
                f"'{camera}_depth' camera: it cannot be aligned"
            )
            yield self._finding("error", text)

    def _unit(self, camera: str, images: list[DepthImage]) -> Iterator[Finding]:
        topic = f"/{camera}/depth"
        valid = np.concatenate([d.raw[d.raw > 0].reshape(-1) for d in images])
        if len(valid) == 0:
            yield self._finding("warning", f"{topic}: every pixel of {len(images)} images is 0 (no return)")
            return
        unit_m = images[0].unit_m
        median_raw = float(np.median(valid))
        table = self._table_ratio(camera, images)
        ratio = table.ratio if table is not None else 1.0
        if table is not None and not 0.6 < ratio < 1.6:
            likely = unit_m / ratio
            unit = min(UNITS_M, key=lambda u: abs(np.log(u / likely)))
            sure = abs(np.log(unit / likely)) < 0.2 and unit != unit_m
            hint = f"; in a unit of {unit * 1000:g} mm it would fit" if sure else ""
            text = (
                f"{topic}: the table appears at {ratio:.2f} times its distance with the unit {unit_m * 1000:g} mm{hint}"
            )
            yield self._finding("error" if sure else "warning", text)
        elif table is None and not PLAUSIBLE_DEPTH_M[0] < median_raw * unit_m < PLAUSIBLE_DEPTH_M[1]:
            fits = [u for u in UNITS_M if PLAUSIBLE_DEPTH_M[0] < median_raw * u < PLAUSIBLE_DEPTH_M[1] and u != unit_m]
            hint = (
                f"; in a unit of {' or '.join(f'{u * 1000:g}' for u in fits)} mm it would be plausible" if fits else ""
            )
            text = f"{topic}: the median depth is {median_raw * unit_m:.3g} m with the unit {unit_m * 1000:g} mm{hint}"
            yield self._finding("warning", text)

    def _table_ratio(self, camera: str, images: list[DepthImage]) -> Plausibility | None:
        """Measured depth over the depth of the plane z = 0 of `world`; None where the calibration does not tell it."""
        lens = self.toss.calibration.cameras.get(f"{camera}_depth") or self.toss.calibration.cameras.get(camera)
        if lens is None or (lens.height, lens.width) != images[0].raw.shape:
            return None
        world_from_lens = self.toss.calibration.find("world", lens.frame)
        if world_from_lens is None:
            return None
        expected_m = _plane_depth(lens, world_from_lens.rotation[2], float(world_from_lens.translation_m[2]))
        near = (expected_m > 0) & (expected_m < 2.0)
        quotients = []
        for image in images:
            raw = image.raw[::4, ::4]
            seen = near & (raw > 0)
            quotients.append(raw[seen] * image.unit_m / expected_m[seen])
        joined = np.concatenate(quotients)
        return Plausibility(float(np.median(joined)), len(joined)) if len(joined) > 500 else None

    def _masks(self) -> Iterator[Finding]:
        masks = self.toss.masks()
        cameras = [c for c in self.toss.cameras() if f"/{c}/color" in self.topics]
        for position in masks:
            frames = self.toss.color(cameras[0]) if cameras else None
            if frames is None or position >= len(frames):
                text = (
                    f"a mask of colour frame {position}, of which there are {len(frames) if frames is not None else 0}"
                )
                yield self._finding("error", text)
                continue
            yield from self._mask(position, masks, frames[position])

    def _mask(self, position: int, masks: GivenMasks, image: EncodedImage) -> Iterator[Finding]:
        try:
            found = limits.image_size(masks.png(position))
            if found is not None and found != (image.width, image.height):
                text = f"{found[0]}x{found[1]}, the image {image.width}x{image.height}"
                yield self._finding("error", f"the mask of frame {position} is {text}")
            elif self._may_look(image.width * image.height) and not masks[position].any():
                yield self._finding("warning", f"the mask of frame {position} is empty")
        except TosslabError as wrong:
            yield self._finding("error", str(wrong))

    def _may_look(self, pixels: int) -> bool:
        """Whether so many more pixels are decoded: every image of a lab's toss, not every image of a file of blanks."""
        self.pixels_left -= pixels
        return self.pixels_left >= 0


def _plane_depth(lens: CameraModel, normal: Float[Array, "3"], height_m: float) -> Float[Array, "h w"]:
    """Depth along the axis at which every fourth pixel's ray meets the plane; 0 where it does not."""
    u, v = np.meshgrid(np.arange(0.0, lens.width, 4), np.arange(0.0, lens.height, 4))
    falls = lens.rays(np.stack([u, v], -1)) @ normal
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = -height_m / falls
    return np.where(np.isfinite(depth_m) & (depth_m > 0), depth_m, 0.0)


def _sampled(count: int) -> list[int]:
    return sorted({int(i) for i in np.linspace(0, count - 1, min(count, LOOKED_AT))}) if count else []


def _first(missing: Int64[Array, " n"]) -> str:
    return f", first after message {int(np.flatnonzero(missing)[0])}"
