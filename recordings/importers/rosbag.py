"""`toss-session import rosbag`: ROS 1 and ROS 2 bags (.bag, folder, .mcap, .db3) of the usual image topics.

One bag is one toss. Colour is `d455`, its depth beside it; other grey images become `mono0`, `mono1`, ... in the
order of their topics. Times are the headers' stamps (mid-exposure, as far as the driver says), log times when the bag
received them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from recordings.errors import BadInput
from recordings.geometry import CameraModel
from recordings.importers import common
from recordings.importers.common import ImportReport, Timed, Warnings
from recordings.importers.ros_bag_file import Bag
from recordings.importers.ros_messages import Pixels, color_image, depth_image, joint_states, stamp_ns
from recordings.importers.ros_topics import Topics, choose, describe
from recordings.mcap.toss_writer import TossWriter
from recordings.progress import Progress, Silent
from recordings.records import DepthImage, EncodedImage
from recordings.tracks import RigCalibration

FLOAT_DEPTH_UNIT_M = 0.00025
"""Depth in float metres (32FC1) is kept in steps of 0.25 mm, up to 16.4 m."""
ARM_BATCH = 50


def import_rosbag(
    sources: Sequence[Path],
    out: Path,
    color: str | None = None,
    depth: str | None = None,
    progress: Progress | None = None,
) -> ImportReport:
    """Make a session at `out`, one toss per bag. `color` and `depth` name the topics where a bag has several that fit.

    Raises BadInput (no images, unknown encodings, stamps that go back) or WriteFailed; then nothing is left at `out`.
    """
    progress, warnings = progress or Silent(), Warnings()
    tosses: list[tuple[Path, Topics]] = []
    for source in sources:
        with closing(Bag(source)) as bag:
            tosses.append((source, choose(bag, color, depth)))
    with closing(Bag(sources[0])) as bag:
        calibration = describe(bag, tosses[0][1], warnings)
    start = common.new_start(out, "rosbag", sources[0], "the headers' own", assumed=False, object={"name": "object"})
    start["rig"] = {"cameras": sorted(calibration.cameras), "topics": [vars(topics) for _, topics in tosses]}
    with common.new_session(out, start, calibration) as writer:
        for number, (source, topics) in enumerate(tosses):
            progress.step(number, len(tosses), source.name)
            with writer.toss(number, {"source": source.name}) as toss, closing(Bag(source)) as bag:
                _write_toss(toss, bag, topics, calibration, warnings)
    progress.step(len(tosses), len(tosses))
    return common.report(writer, "rosbag", warnings)


def _write_toss(toss: TossWriter, bag: Bag, topics: Topics, calibration: RigCalibration, warnings: Warnings) -> None:
    arm = list(_arm(toss, bag, topics.joints, warnings)) if topics.joints else []
    common.write_in_order(_images(toss, bag, topics, calibration, warnings), arm)


def _images(
    toss: TossWriter, bag: Bag, topics: Topics, calibration: RigCalibration, warnings: Warnings
) -> Iterator[Timed]:
    """All images of a bag in one pass, in the order of reception, which is the session's log time."""
    cameras = {topic: name for name, topic in (("d455", topics.color), *topics.mono.items()) if topic}
    clocks = {topic: _Clock(bag, topic, warnings) for topic in (*cameras, topics.depth) if topic}
    counts = dict.fromkeys(clocks, 0)
    for topic, received_ns, message in bag.messages(*clocks):
        time_ns, index = clocks[topic].time_ns(message, received_ns), _number(message, counts[topic])
        counts[topic] += 1
        if topic == topics.depth:
            raw, unit_m = depth_image(message, bag.path, topic, FLOAT_DEPTH_UNIT_M)
            if unit_m == FLOAT_DEPTH_UNIT_M:
                warnings.add(f"{topic} is depth in float metres: kept in steps of {FLOAT_DEPTH_UNIT_M * 1000:g} mm")
            depth = DepthImage("d455", index, time_ns, received_ns, unit_m, raw)
            yield received_ns, partial(toss.depth, depth)
            continue
        camera = cameras[topic]
        pixels = color_image(message, bag.path, topic, grey=camera != "d455")
        _check_size(pixels, calibration.cameras.get(camera), bag, topic)
        image = EncodedImage(
            camera, index, time_ns, received_ns, pixels.encoding, pixels.width, pixels.height, pixels.data
        )
        yield received_ns, partial(toss.color if camera == "d455" else toss.mono, image)


def _check_size(pixels: Pixels, camera: CameraModel | None, bag: Bag, topic: str) -> None:
    if camera is not None and (pixels.width, pixels.height) != (camera.width, camera.height):
        raise BadInput(
            f"{bag.path}: an image of {topic} is {pixels.width}x{pixels.height}, its camera_info says "
            f"{camera.width}x{camera.height}; wanted the camera matrix of these images"
        )


class _Clock:
    """Header stamps of one topic as they come; refuses what repeats or goes back."""

    def __init__(self, bag: Bag, topic: str, warnings: Warnings) -> None:
        self._name, self._topic, self._warnings = bag.path.name, topic, warnings
        self._last_ns: int | None = None

    def time_ns(self, message: Any, received_ns: int) -> int:
        time_ns = stamp_ns(message)
        if time_ns == 0:
            self._warnings.add(f"{self._name}: {self._topic} has no stamps; the times of reception are used")
            time_ns = received_ns
        if self._last_ns is not None:
            common.growing(np.array([self._last_ns, time_ns], dtype=np.int64), f"{self._name}: {self._topic}")
        self._last_ns = time_ns
        return time_ns


def _number(message: Any, position: int) -> int:
    """ROS 1 headers count messages; ROS 2's do not."""
    return int(getattr(message.header, "seq", 0)) or position


def _arm(toss: TossWriter, bag: Bag, topic: str, warnings: Warnings) -> Iterator[Timed]:
    received, states = joint_states(bag, topic, warnings)
    if states is None:
        return
    stamps = common.growing(states.time_ns, f"{bag.path.name}: {topic}")
    for i in range(0, len(stamps), ARM_BATCH):
        yield int(received[i]), partial(toss.arm, states.part(slice(i, i + ARM_BATCH)))
