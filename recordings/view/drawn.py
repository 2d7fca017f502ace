"""The picture of `toss-view --screenshot` where no graphics driver is: drawn in software, as a frame of a film."""

from __future__ import annotations

import cv2
import numpy as np

from recordings.film.film import Film
from recordings.session import Toss
from recordings.tracks import ObjectTrack
from recordings.view.scene import Body, Scene, moment_ns, root_poses

CAMERA = "d455"


def drawn_picture(scene: Scene, toss: int) -> bytes | None:
    """PNG of a telling moment of a toss: colour with the outline of the shown estimate (else of the truth), the scene.

    None where there is no colour image, or no model of its camera, to draw on.
    """
    recorded = scene.toss(toss)
    if recorded is None or CAMERA not in scene.calibration.cameras or len(recorded.color(CAMERA)) == 0:
        return None
    body = next((b for b in reversed(scene.bodies) if b.shown and b.poses.get(toss)), None)
    track = _on_frames(scene, body, toss, recorded)
    film = Film(recorded, scene.calibration, track, None if body is None else body.shape(toss))
    image = film[recorded.color(CAMERA).nearest(moment_ns(scene, toss))]
    return cv2.imencode(".png", image[..., ::-1])[1].tobytes()


def _on_frames(scene: Scene, body: Body | None, toss: int, recorded: Toss) -> ObjectTrack:
    """The body's poses at the colour frames (the nearest within half a frame; lost where there is none)."""
    nowhere = ObjectTrack.nowhere(toss, CAMERA, recorded.color(CAMERA).times_ns)
    camera_from_root = scene.calibration.find(scene.calibration.camera(CAMERA).frame, scene.root)
    if body is None or camera_from_root is None:
        return nowhere
    times_ns, root_from_object = root_poses(scene, body.poses[toss])
    poses, status = nowhere.camera_from_object.copy(), list(nowhere.status)
    half_ns = np.median(np.diff(nowhere.time_ns)) / 2 if len(nowhere.time_ns) > 1 else 0
    for i, time_ns in enumerate(nowhere.time_ns):
        k = int(np.abs(times_ns - time_ns).argmin()) if len(times_ns) else 0
        if len(times_ns) and abs(times_ns[k] - time_ns) <= half_ns and np.isfinite(root_from_object[k]).all():
            poses[i] = camera_from_root.matrix @ root_from_object[k]
            status[i] = "interpolated" if body.poses[toss][k].status == "interpolated" else "tracked"
    return ObjectTrack(toss, CAMERA, "object", nowhere.time_ns, poses, tuple(status), nowhere.covariance)
