"""Frames of a film about one toss: the colour image with the object's outline, the scene in 3D beside it.

An outline's colour says how far a pose is to be trusted: green tracked, orange interpolated; a lost frame has none, and
says so in red.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.film.raster import covered_pixels, outlined
from recordings.film.scene import Stage, path_m
from recordings.mcap.codec import decode_image
from recordings.session import Toss
from recordings.tracks import ObjectShape, ObjectTrack, RigCalibration, Status

STATUS_RGB: Mapping[Status, tuple[int, int, int]] = {
    "tracked": (40, 210, 90), "interpolated": (255, 165, 0), "lost": (235, 40, 40),
}  # fmt: skip
LOWEST_PX = 480
"""Small images are drawn at a multiple of their size, so that this is reached."""
BAR_PX = 32
BAR_RGB, INK_RGB = (25, 25, 25), (225, 225, 225)
FONT = cv2.FONT_HERSHEY_SIMPLEX


class Film:
    """The frames of one toss, drawn when asked for: `film[i]` is an image of even size, one per colour frame.

    `shape` None: only the way of the object is drawn. `slowed`: said in the picture.
    Raises BadInput where the recording is not the one that the track is of.
    """

    def __init__(
        self, toss: Toss, calibration: RigCalibration, track: ObjectTrack, shape: ObjectShape | None, slowed: str = ""
    ) -> None:
        self._frames = toss.color(track.camera)
        if len(self._frames) != len(track.status):
            raise BadInput(
                f"{toss.path.name} has {len(self._frames)} colour frames, the track has {len(track.status)}: these "
                "results are not of this recording; wanted the session that they were made from"
            )
        self.track, self.shape, self._toss, self._slowed = track, shape, toss, slowed
        self._calibration = calibration
        camera = calibration.camera(track.camera)
        self.factor = -(-LOWEST_PX // camera.height) if camera.height < LOWEST_PX else 1
        self._camera = camera.scaled(float(self.factor)) if self.factor > 1 else camera

    def __len__(self) -> int:
        return len(self.track.status)

    def __iter__(self) -> Iterator[UInt8[Array, "h w 3"]]:
        return (self[i] for i in range(len(self)))

    def __getitem__(self, i: int) -> UInt8[Array, "h w 3"]:
        seen, scene = self.color(i), self.scene(i)
        joined = np.hstack([seen, scene])
        return _even(np.vstack([joined, self._bar(i, joined.shape[1])]))

    def color(self, i: int) -> UInt8[Array, "h w 3"]:
        """The colour image with the outline in its status's colour."""
        image = decode_image(self._frames[i])
        if self.factor > 1:
            image = cv2.resize(image, None, fx=self.factor, fy=self.factor, interpolation=cv2.INTER_CUBIC)
        pose = self.track.pose(i)
        if pose is None or self.shape is None:
            return np.asarray(image, dtype=np.uint8)
        mask = covered_pixels(self.shape, pose, self._camera)
        return outlined(image, mask, STATUS_RGB[self.track.status[i]], 2)

    def scene(self, i: int) -> UInt8[Array, "s s 3"]:
        """The object at its pose, with the way it came."""
        colors = tuple(STATUS_RGB[s] for s in self.track.status[: i + 1])
        return self._stage.picture(self.shape, self.track.pose(i), self._path[: i + 1], colors)

    @cached_property
    def _path(self) -> Float[Array, "n 3"]:
        return path_m(self.track, self.shape)

    @cached_property
    def _stage(self) -> Stage:
        return Stage.of(self._toss, self._calibration, self.track, self.shape, self._camera.height)

    def _bar(self, i: int, width: int) -> UInt8[Array, "h w 3"]:
        """A line of words below: the toss, the time, the status in its colour."""
        status, time_ns = self.track.status[i], self.track.time_ns
        bar = np.full((BAR_PX, width, 3), BAR_RGB, dtype=np.uint8)
        time_s = 1e-9 * int(time_ns[i] - time_ns[0])
        words = f"toss {self.track.toss}   frame {i + 1} of {len(self)}   {time_s:.2f} s   "
        start = 10 + cv2.getTextSize(words, FONT, 0.55, 1)[0][0]
        cv2.putText(bar, words, (10, 21), FONT, 0.55, INK_RGB, 1, cv2.LINE_AA)
        cv2.putText(bar, status, (start, 21), FONT, 0.55, STATUS_RGB[status], 1, cv2.LINE_AA)
        room = width - 10 - cv2.getTextSize(self._slowed, FONT, 0.55, 1)[0][0]
        cv2.putText(bar, self._slowed, (room, 21), FONT, 0.55, INK_RGB, 1, cv2.LINE_AA)
        return bar


def _even(image: UInt8[Array, "h w 3"]) -> UInt8[Array, "h2 w2 3"]:
    """Without the last row or column where their number is odd: video codecs halve the colours."""
    return np.ascontiguousarray(image[: image.shape[0] // 2 * 2, : image.shape[1] // 2 * 2])
