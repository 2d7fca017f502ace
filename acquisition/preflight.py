"""Before the first toss: is everything there, at its rate, sharp, steadily lit, calibrated, with room on the disk?"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.devices import Image, RgbdCamera
from acquisition.disk import expected_bytes_s, free_bytes
from acquisition.streaming.recorder import Recorder
from acquisition.streaming.streams import Tally
from recordings.tracks import RigCalibration

State = Literal["ok", "warning", "fail"]
RATE_OFF, RATE_BAD = 0.04, 0.2
FASTEST_M_S = 2.0
"""Of an object that falls from 0.2 m; blur is stated for it."""
BLUR_PX, BLUR_BAD_PX = 3.0, 10.0
FLICKER = 0.015
DOTS = 1.25
EMITTER_SETTLES_S = 0.5
DRIFT_PX, DRIFT_BAD_PX = 0.5, 2.0
CLOCK_SIGMA_S, CLOCK_DRIFT = 0.5e-3, 200e-6
DISTANCE_M = 1.0
DARK, BRIGHT = 12.0, 245.0


@dataclass(frozen=True)
class Row:
    """One line of the table. `wanted` is what to do where it is not ok."""

    check: str
    subject: str
    state: State
    found: str
    wanted: str = ""


@dataclass(frozen=True)
class Preflight:
    rows: tuple[Row, ...]

    @property
    def failed(self) -> tuple[Row, ...]:
        return tuple(r for r in self.rows if r.state == "fail")

    def text(self) -> str:
        """The table, a line a check."""
        widths = [max(len(getattr(r, name)) for r in self.rows) for name in ("check", "subject", "state")]
        return "\n".join(
            f"{r.state:<{widths[2]}}  {r.check:<{widths[0]}}  {r.subject:<{widths[1]}}  {r.found}"
            + (f"  -> {r.wanted}" if r.state != "ok" and r.wanted else "")
            for r in self.rows
        )


def preflight(recorder: Recorder, calibration: RigCalibration, folder: Path, seconds: float = 2.0) -> Preflight:
    """Look at what flows for a while, and judge."""
    recorder.troubles()
    before, started = recorder.tallies(), time.monotonic()
    brightness = _watch(recorder, seconds)
    counts = {topic: tally.since(before[topic]) for topic, tally in recorder.tallies().items()}
    watched_s = time.monotonic() - started
    rows = [
        *devices(recorder),
        *rates(recorder, counts, watched_s),
        *exposures(recorder, calibration),
        *flicker(brightness),
        *dots(recorder),
        *tags(recorder, calibration),
        *calibration_age(calibration, recorder.rig.calibration_hours, time.time()),
        *clocks(recorder),
        disk(recorder, folder),
    ]
    return Preflight(tuple(rows))


def of_recording(recorder: Recorder, calibration: RigCalibration, folder: Path) -> Preflight:
    """What can be asked of a recording before it is played."""
    age = calibration_age(calibration, float("inf"), time.time())
    return Preflight((*devices(recorder), *age, disk(recorder, folder)))


def _watch(recorder: Recorder, seconds: float) -> dict[str, list[float]]:
    """The mean grey of each stream's pictures, frame by frame."""
    seen: dict[str, list[float]] = {}
    last: dict[str, int] = {}
    ends = time.monotonic() + seconds
    while time.monotonic() < ends:
        for topic, image in list(recorder.latest.items()):
            if not topic.endswith("depth") and last.get(topic) != image.number:
                last[topic] = image.number
                seen.setdefault(topic, []).append(float(image.pixels[::8, ::8].mean()))
        time.sleep(0.005)
    return seen


def devices(recorder: Recorder) -> Iterator[Row]:
    """Every device of the rig, as it names itself."""
    for entry in recorder.rig.devices:
        described = recorder.devices[entry.name].describe()
        found = " ".join(str(described.get(k, "")) for k in ("model", "serial", "firmware")).strip()
        yield Row("device", entry.name, "ok", found)
        for text in described.get("warnings", []):
            yield Row("device", entry.name, "warning", str(text))


def rates(recorder: Recorder, counts: Mapping[str, Tally], seconds: float) -> Iterator[Row]:
    """What came in the time, against what was asked for; lost frames."""
    for entry in recorder.rig.devices:
        for topic, tally in counts.items():
            if topic.split("/")[1] != entry.name and not (entry.kind == "arm" and "/arm/" in topic):
                continue
            got = (tally.received - sum(tally.dropped.get(c, 0) for c in ("duplicate", "out of order"))) / seconds
            off = abs(got / entry.rate_hz - 1)
            state: State = (
                "ok" if off < RATE_OFF + 1 / (entry.rate_hz * seconds) else "warning" if off < RATE_BAD else "fail"
            )
            wanted = f"wanted {entry.rate_hz:g} Hz: check cable, bandwidth, exposure and trigger"
            yield Row("rate", topic, state, f"{got:.1f} Hz", wanted)
            lost = tally.dropped_total + tally.missed
            if lost:
                yield Row("losses", topic, "warning", f"{lost} of {tally.received + tally.missed} lost", "see above")


def exposures(recorder: Recorder, calibration: RigCalibration) -> Iterator[Row]:
    """Blur of the fastest object, v t f / z, and whether the picture is neither black nor white."""
    for topic, image in sorted(recorder.latest.items()):
        if topic.endswith("depth"):
            continue
        name = topic.split("/")[1]
        mean = float(image.pixels[::8, ::8].mean())
        if not DARK < mean < BRIGHT:
            yield Row("exposure", name, "warning", f"mean grey {mean:.0f}", "change light, exposure or gain")
        if np.isnan(image.exposure_s):
            yield Row(
                "exposure", name, "warning", "the camera does not say its exposure", "set exposure_s in the rig file"
            )
            continue
        blur_px = FASTEST_M_S * image.exposure_s * _focal_px(calibration, name, image) / _distance_m(calibration, name)
        state: State = "ok" if blur_px <= BLUR_PX else "warning" if blur_px < BLUR_BAD_PX else "fail"
        shorter_s = image.exposure_s * BLUR_PX / max(blur_px, 1e-9)
        found = f"{1e3 * image.exposure_s:.2f} ms: {blur_px:.1f} px of blur at {FASTEST_M_S:g} m/s"
        yield Row("exposure", name, state, found, f"at most {BLUR_PX:g} px: exposure_s = {shorter_s:.4f}, more light")


def _focal_px(calibration: RigCalibration, name: str, image: Image) -> float:
    camera = calibration.cameras.get(name)
    return camera.fx if camera is not None else 0.95 * image.pixels.shape[1]


def _distance_m(calibration: RigCalibration, name: str) -> float:
    world_from_camera = calibration.find("world", name) if name in calibration.cameras else None
    return DISTANCE_M if world_from_camera is None else float(np.linalg.norm(world_from_camera.translation_m))


def flicker(brightness: Mapping[str, Sequence[float]]) -> Iterator[Row]:
    """Lamps on mains flicker at twice its frequency: frames of one scene differ in brightness."""
    for topic, means in sorted(brightness.items()):
        if len(means) < 10:
            continue
        values = np.array(means)
        rough = float(np.std(np.diff(values)) / np.sqrt(2) / max(values.mean(), 1.0))
        state: State = "ok" if rough < FLICKER else "warning"
        wanted = "lamps on direct current, or an exposure of whole periods (10 ms at 50 Hz)"
        yield Row("flicker", topic.split("/")[1], state, f"{100 * rough:.2f} % from frame to frame", wanted)


def dots(recorder: Recorder) -> Iterator[Row]:
    """The depth camera's infrared dots in the other pictures: their grain with the emitter on against off."""
    camera = next((d for d in recorder.devices.values() if isinstance(d, RgbdCamera)), None)
    if camera is None:
        return
    with_dots = _grain(recorder)
    try:
        camera.set_emitter(False)
        time.sleep(EMITTER_SETTLES_S)
        without = _grain(recorder)
    finally:
        camera.set_emitter(True)
    for topic, grain in sorted(with_dots.items()):
        ratio = grain / max(without.get(topic, grain), 1e-6)
        state: State = "ok" if ratio < DOTS else "warning"
        wanted = "an infrared cut filter on this camera, or a lower laser_power"
        yield Row("infrared dots", topic.split("/")[1], state, f"grain {ratio:.2f} times that without them", wanted)


def _grain(recorder: Recorder) -> dict[str, float]:
    """Fine contrast of each stream: the median over tiles of the Laplacian's deviation."""
    found = {}
    for topic, grey in greys_of(recorder).items():
        fine = cv2.Laplacian(grey, cv2.CV_32F)
        height, width = (s // 8 * 8 for s in fine.shape)
        tiles = fine[:height, :width].reshape(8, height // 8, 8, width // 8).std(axis=(1, 3))
        found[topic] = float(np.median(tiles))
    return found


def tags(recorder: Recorder, calibration: RigCalibration) -> Iterator[Row]:
    """AprilTags in every picture; those of the table where the calibration says (else a camera was moved)."""
    from calibration.tags.detect import TagDetection, detect_tags

    found_in: dict[str, list[TagDetection]] = {}
    for greys in of_one_size(greys_of(recorder)):
        lists = detect_tags(list(greys.values()), calibration.tag_family, jobs=1)
        for k, (topic, found) in enumerate(zip(greys, lists)):
            if k in lists.lost:
                yield Row(
                    "tags", topic.split("/")[1], "warning", "the tag detector died on this picture", "check again"
                )
            else:
                found_in[topic] = found
    for topic, found in found_in.items():
        name = topic.split("/")[1]
        table = {t.tag_id: t for t in calibration.table_tags}
        mine = [t for t in found if t.tag_id in table]
        state: State = "ok" if found else "warning"
        yield Row("tags", name, state, f"{len(found)} seen, {len(mine)} of the table", "light, focus, tags in view")
        off_px = list(_off_px(calibration, name, {t.tag_id: t.corners_px for t in mine}))
        if off_px:
            drift = float(np.median(off_px))
            state = "ok" if drift < DRIFT_PX else "warning" if drift < DRIFT_BAD_PX else "fail"
            wanted = "the camera was moved: toss-record --calibration board, then toss-calibrate cameras"
            yield Row("calibration drift", name, state, f"{drift:.2f} px on {len(off_px)} tags of the table", wanted)


def greys_of(recorder: Recorder) -> dict[str, Array]:
    """The latest picture of every stream that shows visible light, grey."""
    return {
        topic: image.pixels if image.pixels.ndim == 2 else cv2.cvtColor(image.pixels, cv2.COLOR_RGB2GRAY)
        for topic, image in sorted(recorder.latest.items())
        if not topic.endswith("depth") and "infrared" not in topic
    }


def of_one_size(greys: Mapping[str, Array]) -> Iterator[dict[str, Array]]:
    """The same pictures, those of one size together: the tag detector takes such."""
    for shape in sorted({grey.shape for grey in greys.values()}):
        yield {name: grey for name, grey in greys.items() if grey.shape == shape}


def _off_px(calibration: RigCalibration, name: str, corners_px: Mapping[int, Float[Array, "4 2"]]) -> Iterator[float]:
    """How far each table tag's middle is from where the calibration projects it."""
    camera = calibration.cameras.get(name)
    camera_from_world = calibration.find(name, "world") if camera is not None else None
    if camera is None or camera_from_world is None:
        return
    for tag in calibration.table_tags:
        if tag.tag_id in corners_px:
            middle = camera_from_world.points(tag.world_from_tag.translation_m[None])
            half = tag.size_m / 2 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
            expected = camera.project(camera_from_world.points(tag.world_from_tag.points(half)))
            if middle[0, 2] > 0:
                yield float(np.linalg.norm(corners_px[tag.tag_id].mean(axis=0) - expected.mean(axis=0)))


def calibration_age(calibration: RigCalibration, hours: float, now_s: float) -> Iterator[Row]:
    """Whether there is a calibration, and how old it is."""
    if not any("world" in (t.target, t.source) for t in calibration.transforms):
        wanted = "toss-record --calibration board, toss-calibrate, then calibration = ... in the rig file"
        yield Row("calibration", "", "warning", "none: the session gets no camera poses", wanted)
        return
    if calibration.created_unix_s is None:
        yield Row("calibration", "", "warning", "its age is unknown", "calibrate anew")
        return
    age_h = (now_s - calibration.created_unix_s) / 3600
    state: State = "ok" if 0 <= age_h <= hours else "warning"
    yield Row(
        "calibration",
        "",
        state,
        f"{age_h:.1f} hours old",
        f"younger than {hours:g} hours: toss-record --calibration board",
    )


def clocks(recorder: Recorder) -> Iterator[Row]:
    """Every device clock: how well it is mapped, its drift, whether it was set."""
    for name, clock in recorder.clocks().items():
        sigma_s, drift, steps = float(clock["sigma_s"]), float(clock["drift"]), clock["steps"]
        bad = sigma_s > CLOCK_SIGMA_S or abs(drift) > CLOCK_DRIFT or steps
        found = f"mapped to {1e3 * sigma_s:.3f} ms, drift {1e6 * drift:+.1f} ppm, set {len(steps)} times"
        yield Row("clock", name, "warning" if bad else "ok", found, "a quieter machine, or another cable")
    mapped = {name.split(":")[0] for name in recorder.clocks()}
    for entry in recorder.rig.devices:
        if entry.kind in ("rgbd", "mono") and entry.name not in mapped:
            found = "its stamps are times of arrival: some ms off, and jittering"
            yield Row("clock", entry.name, "warning", found, "a camera that stamps by its own clock")


def disk(recorder: Recorder, folder: Path) -> Row:
    """Room for the next toss, twice, and the reserve."""
    config = recorder.rig.recording
    (place, free), bytes_s = free_bytes(folder), expected_bytes_s(recorder)
    wanted = 2 * bytes_s * config.longest_toss_s + config.reserve_gb * 1e9
    found = f"{free / 1e9:.1f} GB free, {bytes_s / 1e6:.0f} MB/s while recording"
    return Row(
        "disk", str(place), "ok" if free >= wanted else "fail", found, f"{wanted / 1e9:.1f} GB for the next toss"
    )
