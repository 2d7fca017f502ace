"""A session while it is recorded, in rerun: the shape so far, the tosses' ways, the verdicts; what `toss-view --live`
shows.

Everything is read from results/live (recordings/results/live.py) and the finished tosses' files. Whether this runs,
and how it ends, is of no matter to the recorder or to what processes.
"""

from __future__ import annotations

import contextlib
import time
import uuid
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, UInt8
from numpy import ndarray as Array

from recordings.errors import TosslabError
from recordings.geometry import CameraModel, Transform
from recordings.mcap.codec import decode_image
from recordings.results.live import TossSoFar, newest_lines, read_state, read_tosses, require_live
from recordings.results.shape_file import read_shape
from recordings.session import Session
from recordings.tracks import ObjectShape, RigCalibration
from recordings.view.mesh import outline_px, smooth_mesh
from recordings.view.viewer import Viewer
from recordings.whole_file import changed_ns, write_bytes

APPLICATION = "toss-view --live"
CAMERA = "d455"
SHAPE, TABLE, IMAGE, WORDS, UPDATE = "shape", "table", "image", "words", "update"
SEEN, UNSEEN = (165, 185, 205), (225, 60, 50)
COLORS = {"tracked": (60, 200, 90), "interpolated": (255, 150, 0)}
OUTLINE_RGB = {"tracked": (60, 230, 100), "interpolated": (255, 150, 0)}
POLL_S = 0.5


class SessionView:
    """The viewer of a session so far. As a context: open until its end."""

    def __init__(self, session: Path, headless: bool = False, size: tuple[int, int] = (1280, 800)) -> None:
        require_live(session)
        self._session = session
        with Session.open(session) as opened:
            self._calibration: RigCalibration = opened.calibration
        self._viewer = Viewer(headless=headless, size=size)
        self._recording = rr.RecordingStream(APPLICATION, recording_id=uuid.uuid4())
        self._seen: tuple[tuple[str, int], ...] = ()
        self._updates = 0

    def __enter__(self) -> SessionView:
        self._viewer.__enter__()
        self._recording.connect_grpc(self._viewer.url)
        self._recording.send_blueprint(self._blueprint())
        return self

    def __exit__(self, *exc: object) -> None:
        with contextlib.suppress(Exception):  # the window may be gone: nothing of it is needed any more
            self._recording.disconnect()
        self._viewer.close()

    def stay(self) -> None:
        """Show what changes until the window is closed."""
        while not self._viewer.closed:
            self.update()
            time.sleep(POLL_S)

    def picture(self) -> bytes:
        """A PNG of the window."""
        self._recording.flush()
        return self._viewer.picture()

    def update(self) -> bool:
        """Draw what is known now; False where nothing changed."""
        files = sorted(require_live(self._session).glob("*.json*"))
        seen = tuple((f.name, about) for f in files if (about := changed_ns(f)) is not None)
        if seen == self._seen:
            return False
        self._seen, self._updates = seen, self._updates + 1
        self._recording.set_time(UPDATE, sequence=self._updates)
        tosses = read_tosses(self._session)
        shape = _shape(require_live(self._session))
        self._words(tosses)
        if shape is not None:
            self._recording.log(SHAPE, shape_so_far(shape))
        self._ways([t for t in tosses if t.placed])
        if tosses:
            self._image(tosses[-1], shape)
        return True

    def _words(self, tosses: Sequence[TossSoFar]) -> None:
        lines, state = newest_lines(self._session, ("next", "learned", "behind", "fault")), read_state(self._session)
        text = words(tosses, {k: v.text for k, v in lines.items()}, "" if state is None else state.state)
        self._recording.log(WORDS, rr.TextDocument(text, media_type=rr.MediaType.MARKDOWN))

    def _ways(self, tosses: Sequence[TossSoFar]) -> None:
        world = self._calibration.find("world", CAMERA)
        root = np.eye(4) if world is None else world.matrix
        self._recording.log(TABLE, rr.Clear(recursive=True))
        for toss in tosses:
            points, colors = _way(toss, root)
            latest = toss is tosses[-1]
            shown = colors if latest else colors // 2 + 60
            name = f"{TABLE}/toss_{toss.toss:02d}"
            self._recording.log(f"{name}/frames", rr.Points3D(points, colors=shown, radii=0.004 if latest else 0.002))
            self._recording.log(f"{name}/way", rr.LineStrips3D([points], colors=[130, 130, 130], radii=0.0008))

    def _image(self, toss: TossSoFar, shape: ObjectShape | None) -> None:
        """A telling frame of the last toss, with the outline of the shape so far."""
        at = _telling(toss)
        with contextlib.suppress(TosslabError, OSError), Session.open(self._session) as session:
            images = session.toss(toss.toss).color(CAMERA)
            picture = np.ascontiguousarray(decode_image(images[images.nearest(toss.time_ns[at])]))
            pose = toss.camera_from_object[at]
            if shape is not None and pose is not None and toss.placed:
                camera = self._calibration.camera(CAMERA)
                picture = outlined(picture, shape, camera, np.array(pose), toss.status[at])
            self._recording.log(IMAGE, rr.Image(picture).compress(jpeg_quality=90))

    def _blueprint(self) -> rrb.Blueprint:
        grid = rrb.LineGrid3D(visible=True, spacing=0.1, color=[120, 120, 120, 90], stroke_width=1.0)
        eye = rrb.EyeControls3D(position=[0.25, -1.0, 0.7], look_target=[0, 0, 0.1], eye_up=[0, 0, 1])
        left = rrb.Vertical(
            rrb.Spatial3DView(
                origin=SHAPE, name="The shape so far (red: not seen yet)", line_grid=rrb.LineGrid3D(visible=False)
            ),
            rrb.Spatial3DView(
                origin=TABLE, name="The tosses (green: tracked, orange: flagged)", line_grid=grid, eye_controls=eye
            ),
        )
        right = rrb.Vertical(
            rrb.TextDocumentView(origin=WORDS, name="So far"),
            rrb.Spatial2DView(origin=IMAGE, name="The last toss"),
            row_shares=[3, 2],
        )
        return rrb.Blueprint(
            rrb.Horizontal(left, right, column_shares=[2, 3]),
            rrb.TimePanel(state="hidden", timeline=UPDATE, play_state="following"),
            rrb.BlueprintPanel(state="hidden"),
            rrb.SelectionPanel(state="hidden"),
            rrb.TopPanel(state="hidden"),
            auto_views=False,
        )


def show_live(session: Path, screenshot: Path | None = None) -> Path | None:
    """The viewer until its window is closed, or one picture of what is known now. Raises BadInput, ViewerFailed."""
    with SessionView(session, headless=screenshot is not None) as view:
        if screenshot is None:
            view.stay()
            return None
        view.update()
        write_bytes(screenshot, view.picture())
        return screenshot


def words(tosses: Sequence[TossSoFar], lines: dict[str, str], state: str) -> str:
    """The verdicts and what to throw next (Markdown)."""
    text = [f"**{lines[k]}**\n" for k in ("next", "learned") if k in lines]
    text += [f"{lines[k]}\n" for k in ("behind", "fault") if k in lines]
    text += ["| toss | tracked | flagged | lost | place | verdict |", "|---|---|---|---|---|---|"]
    for toss in reversed(tosses):
        place = "none" if not toss.placed else "twin?" if toss.ambiguous else "sure"
        verdict = "good" if toss.good else "; ".join(toss.verdict)
        text.append(
            f"| {toss.toss} | {toss.tracked} of {toss.frames} | {toss.interpolated} | {toss.lost} | {place} | "
            f"{verdict} |"
        )
    return "\n".join([*text, "", f"({state})"] if state else text)


def shape_so_far(shape: ObjectShape) -> rr.Mesh3D:
    """The mesh, what no view saw in red."""
    observed = np.ones(len(shape.vertices_m), dtype=bool) if shape.observed is None else shape.observed
    colors = np.where(observed[:, None], SEEN, UNSEEN).astype(np.uint8)
    return smooth_mesh(shape, vertex_colors=colors)


def outlined(
    picture: UInt8[Array, "h w 3"], shape: ObjectShape, camera: CameraModel, pose: Float[Array, "4 4"], status: str
) -> UInt8[Array, "h w 3"]:
    """The colour image with the shape's outline at a pose."""
    strips = outline_px(shape, camera, Transform.from_matrix(camera.frame, shape.object_frame, pose))
    out = picture.copy()
    for strip in strips:
        cv2.polylines(out, [np.round(strip).astype(np.int32)], True, OUTLINE_RGB.get(status, (255, 255, 255)), 1)
    return out


def _way(toss: TossSoFar, root_from_camera: Float[Array, "4 4"]) -> tuple[Float[Array, "n 3"], Array]:
    """Where the object was in each frame that has a pose, and the colour of its status."""
    kept = [(p, s) for p, s in zip(toss.camera_from_object, toss.status) if p is not None and s in COLORS]
    if not kept:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.uint8)
    poses = root_from_camera @ np.array([p for p, _ in kept])
    return poses[:, :3, 3], np.array([COLORS[s] for _, s in kept], dtype=np.uint8)


def _telling(toss: TossSoFar) -> int:
    """Amid the flight, else the middle frame."""
    release, impact, _ = toss.phases
    at = len(toss.status) // 2 if release is None or impact is None else (release + impact) // 2
    return min(at, len(toss.status) - 1)


def _shape(folder: Path) -> ObjectShape | None:
    try:
        return read_shape(folder)
    except (TosslabError, OSError):
        return None  # none yet, or it is being replaced
