"""A session, a toss's file or a results folder in rerun: as an .rrd file, as a picture, or in the viewer's window."""

from __future__ import annotations

import contextlib
import uuid
from dataclasses import dataclass
from pathlib import Path

import rerun as rr

from recordings.console import has_display
from recordings.errors import BadInput, WriteFailed
from recordings.mcap.file import McapFile
from recordings.progress import Progress, Silent
from recordings.results.folder import Results
from recordings.session import Session
from recordings.view.arm import known_arm, log_arm_model, log_arm_motion
from recordings.view.blueprint import ABOUT, about_text, blueprint
from recordings.view.bodies import log_bodies, log_rig
from recordings.view.cycle import log_cycle
from recordings.view.drawn import drawn_picture
from recordings.view.layers import EVENTS, TIME, Clock, Steps, log_toss
from recordings.view.rrd_file import PipedFile
from recordings.view.scene import Scene, moment_ns, result_bodies, results_scene, session_scene
from recordings.view.track import log_tracking
from recordings.view.truth import log_truth
from recordings.view.viewer import NoGraphics, Viewer, ViewerFailed, run_rerun
from recordings.whole_file import write_bytes

APPLICATION = "tosslab"
RRD_MAGIC = b"RRF2"
SILENT = Silent()
NO_DRIVER = "there is no graphics driver (Mesa's: `apt-get install -y libvulkan1 mesa-vulkan-drivers`)"
DRAWN = "so the picture is drawn in software, without plots and clouds"
LEFT_OUT = "so the picture is left out: without one, only the colour images of a session can be drawn on"


@dataclass(frozen=True)
class Choice:
    """What of a path is shown. None: all tosses, all variants of the results (the likeliest one visible)."""

    toss: int | None = None
    variant: str | None = None
    scope: str | None = None


@dataclass(frozen=True)
class Shot:
    """Whether a picture was written; `said`: how it was drawn, or why it was left out, where that needs a word."""

    written: bool
    said: str = ""


def save_rrd(path: Path, out: Path, choice: Choice = Choice(), progress: Progress = SILENT) -> None:
    """Write what `toss-view PATH` shows to an .rrd file, whole or not at all.

    A foreign .mcap goes through rerun's own loader.

    Raises BadInput for a path that is nothing of the kind, or an `out` that exists; WriteFailed for the disk.
    """
    if out.exists():
        raise BadInput(f"{out} exists already; nothing was written. Choose another name or remove it")
    if is_rrd(path):
        raise BadInput(f"{path} is an .rrd already; nothing was written. Look at it with `toss-view {path}`")
    scene = None if is_foreign(path) else open_scene(path, choice)
    partial = out.with_name(out.name + ".partial")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if scene is None:
            run_rerun("mcap", "convert", str(path), "-o", str(partial))
        else:
            _write(scene, partial, progress)
        partial.replace(out)
    except OSError as refused:
        raise WriteFailed(f"{out} cannot be written: {refused.strerror}") from refused
    finally:
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)


def _write(scene: Scene, out: Path, progress: Progress) -> None:
    recording = _recording(scene)
    file = PipedFile(out)
    try:
        recording.save(file.path, default_blueprint=blueprint(scene))
        fill(recording, scene, progress)
    finally:
        recording.disconnect()
        file.close()


def screenshot(path: Path, out: Path, choice: Choice = Choice(), size: tuple[int, int] = (1280, 800)) -> Shot:
    """Write a PNG of the viewer's window at a telling moment of the first toss (the middle of its flight).

    No display is needed. Without a graphics driver the moment is drawn in software, or left out where the path is not
    of a session.
    """
    scene = None if is_foreign(path) else open_scene(path, choice)
    said, picture = "", None
    try:
        picture = _viewed(path, scene, size)
    except NoGraphics:
        picture = None if scene is None else drawn_picture(scene, scene.tosses[0])
        said = f"{NO_DRIVER}, {LEFT_OUT if picture is None else DRAWN}"
    if picture is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_bytes(out, picture)
    return Shot(picture is not None, said)


def _viewed(path: Path, scene: Scene | None, size: tuple[int, int]) -> bytes:
    """The viewer's picture of a scene, or of a file that is not ours."""
    with Viewer(headless=True, size=size) as viewer:
        if scene is None:
            viewer.client.open(str(path.resolve()))
        else:
            toss = scene.tosses[0]
            stream(scene, viewer, tosses=(toss,))
            shift_ns = scene.shift_ns[toss]
            viewer.wait_for(TIME, scene.spans_ns[toss][1] + shift_ns)
            viewer.show(TIME, moment_ns(scene, toss) + shift_ns)
        return viewer.picture()


def open_viewer(path: Path, choice: Choice = Choice(), progress: Progress = SILENT) -> None:
    """Open the viewer's window and stay until it is closed. Raises ViewerFailed where there is no display."""
    scene = None if is_foreign(path) else open_scene(path, choice)
    if not has_display():
        raise ViewerFailed(
            "there is no display here for the viewer's window; "
            f"write a file with `toss-view {path} --save out.rrd` and open it where there is one with `rerun out.rrd`, "
            f"or make a picture with `toss-view {path} --screenshot out.png`"
        )
    with Viewer(headless=False, size=(1600, 1000)) as viewer:
        if scene is None:
            viewer.client.open(str(path.resolve()))
        else:
            stream(scene, viewer, progress)
        viewer.wait_until_closed()


def stream(scene: Scene, viewer: Viewer, progress: Progress = SILENT, tosses: tuple[int, ...] | None = None) -> None:
    """Send a scene, or some tosses of it, to a running viewer; returns when all of it has arrived."""
    recording = _recording(scene)
    recording.connect_grpc(viewer.url, default_blueprint=blueprint(scene))
    fill(recording, scene, progress, tosses)
    recording.disconnect()


def open_scene(path: Path, choice: Choice = Choice()) -> Scene:
    """What is at a path: a session, one toss's file, or a results folder. Raises BadInput with what to type next."""
    if path.is_dir() and Results.is_results(path):
        scene = results_scene(Results.open(path), choice.variant, choice.scope)
    else:
        session = Session.open(path)
        has_results = path.is_dir() and Results.is_results(path / "results")
        if (choice.variant or choice.scope) and not has_results:
            raise BadInput(f"{path} has no results, so no variant to choose; run `toss-process {path}` first")
        found = result_bodies(Results.open(path), choice.variant, choice.scope) if has_results else []
        scene = session_scene(session, found)
    if choice.toss is None:
        return scene
    if choice.toss not in scene.tosses:
        raise BadInput(f"{path} has no toss {choice.toss}; it has {', '.join(map(str, scene.tosses))}")
    return scene.only((choice.toss,))


def is_foreign(path: Path) -> bool:
    """Whether this is a file that rerun's own loader opens: an .rrd, or an MCAP file of someone else."""
    if is_rrd(path):
        return True
    if not path.is_file():
        return False
    with McapFile(path) as file:
        return not file.metadata("tosslab")


def is_rrd(path: Path) -> bool:
    if not path.is_file():
        return False
    with open(path, "rb") as file:
        return file.read(len(RRD_MAGIC)) == RRD_MAGIC


def fill(
    recording: rr.RecordingStream, scene: Scene, progress: Progress, tosses: tuple[int, ...] | None = None
) -> None:
    """Log a scene (or some tosses of it) toss by toss, so that a live viewer has the first one at once."""
    recording.log(ABOUT, rr.TextDocument(about_text(scene), media_type=rr.MediaType.MARKDOWN), static=True)
    log_rig(recording, scene)
    robot = known_arm(scene)
    if robot is not None:
        log_arm_model(recording, robot)
    chosen = scene.tosses if tosses is None else tosses
    steps = Steps(progress, scene, chosen)
    for toss in chosen:
        clock = Clock(recording, toss, scene.shift_ns[toss])
        start_ns, end_ns = scene.spans_ns[toss]
        clear(clock.at(start_ns))
        clock.at(start_ns).log(EVENTS, rr.TextLog(f"toss {toss}: recording begins"))
        log_bodies(recording, scene, toss)
        log_truth(clock, scene)
        for body in scene.bodies:
            log_tracking(clock, scene, body)
            log_cycle(clock, scene, body)
        if robot is not None:
            log_arm_motion(recording, scene, robot, toss)
        log_toss(recording, scene, toss, steps)
        flush(recording)  # the end is the last to arrive: who sees it has all of the toss
        clock.at(end_ns).log(EVENTS, rr.TextLog(f"toss {toss}: recording ends"))
        flush(recording)
        steps.next(f"toss {toss}")


def flush(recording: rr.RecordingStream) -> None:
    """Wait until everything logged so far is sent on. Raises ViewerFailed where nobody takes it any more."""
    try:
        recording.flush()
    except RuntimeError as lost:
        raise ViewerFailed(f"the recording was not sent to its end ({lost}); was the viewer closed?") from lost


def clear(recording: rr.RecordingStream) -> None:
    """Nothing of the toss before is left in the picture when the next one begins."""
    for entity in ("world/seen_by", "world/cameras", "world/path", "world/rejected", "model", "flat", "depth"):
        recording.log(entity, rr.Clear(recursive=True))


def _recording(scene: Scene) -> rr.RecordingStream:
    recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
    rr.set_log_time_enabled(False, recording=recording)  # one time line: the session clock's
    rr.set_log_tick_enabled(False, recording=recording)
    recording.send_recording_name(scene.name)
    return recording
