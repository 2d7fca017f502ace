"""How the viewer's window is laid out, and the words that explain it."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.view.arm import BASE
from recordings.view.bodies import BODY, PATH
from recordings.view.cycle import cycle_plots, cycle_words, hidden_entities, step_views
from recordings.view.layers import ARM, DEPTH, EVENTS, FRAMES, HEALTH, MOTION, TIME, Clock, image_entity
from recordings.view.scene import Body, Scene, root_poses
from recordings.view.track import FIGURES, MATCHES, MODEL

ABOUT = "about"
EYE_FROM_TARGET = np.array([1.0, -0.75, 0.6])
"""Where the first look comes from, in world axes: from the right, behind the colour camera's shoulder, from above."""
ELBOW_M = np.array([0.0, 0.0, 0.7])
HALF_VIEW = 0.55
"""Tangent of the half angle that must hold everything; the eye sees a little more."""
SLOW = 0.25
MODEL_EYE = [0.2, -0.25, -0.4]
"""Where the model is seen from, in the object's frame, which is the camera's when tracking begins."""
FIGURE_NAMES = {"residual": "Residual (0..1)", "on_surface": "On the surface", "mask_confidence": "Mask confidence"}


def blueprint(scene: Scene) -> rrb.Blueprint:
    """The table in 3D on the left; images and plots on the right; time over the first toss, four times slowed down."""
    right = [container for container in (_images(scene), _plots(scene), _words()) if container is not None]
    return rrb.Blueprint(
        rrb.Horizontal(_spaces(scene), rrb.Vertical(*right, row_shares=[4, 2, 2][: len(right)]), column_shares=[3, 2]),
        _time_panel(scene),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TopPanel(state="collapsed"),
        auto_views=False,
    )


def _time_panel(scene: Scene) -> rrb.TimePanel:
    toss = scene.tosses[0]
    clock = Clock(rr.RecordingStream("unused"), toss, scene.shift_ns[toss])
    start, end = (clock.shown(t) for t in scene.spans_ns[toss])
    return rrb.TimePanel(
        state="collapsed",
        timeline=TIME,
        playback_speed=SLOW,
        play_state="playing",
        loop_mode="selection",
        time_selection=rr.encodings.AbsoluteTimeRange(min=start.astype(int), max=end.astype(int)),
    )


def _spaces(scene: Scene) -> rrb.Container:
    """The table, and in a tab behind it the object's model as it grew, in the object's own frame."""
    model = [
        rrb.Spatial3DView(
            origin=MODEL.format(body.name),
            name="The object as seen so far",
            line_grid=rrb.LineGrid3D(visible=False),
            eye_controls=rrb.EyeControls3D(position=MODEL_EYE, look_target=[0, 0, 0], eye_up=[0, -1, 0]),
        )
        for body in scene.bodies
        if body.shown and body.notes
    ]
    return rrb.Tabs(_space(scene), *model, *step_views(scene), active_tab=0)


def _space(scene: Scene) -> rrb.Spatial3DView:
    hidden = [body for body in scene.bodies if not body.shown]
    paths = [*(e.format(body.name) for body in hidden for e in (BODY, PATH)), *hidden_entities(scene)]
    overrides = {path: rrb.EntityBehavior(visible=False) for path in paths}
    if scene.root != "world":
        return rrb.Spatial3DView(origin="world", name=f"As seen from {scene.root}", overrides=overrides)
    position, target = first_look(scene)
    grid = rrb.LineGrid3D(visible=True, spacing=0.1, color=[120, 120, 120, 90], stroke_width=1.0)
    eye = rrb.EyeControls3D(position=position, look_target=target, eye_up=[0, 0, 1])
    return rrb.Spatial3DView(
        origin="world", name="The table in 3D", overrides=overrides, line_grid=grid, eye_controls=eye
    )


def first_look(scene: Scene) -> tuple[Float[Array, "3"], Float[Array, "3"]]:
    """Where the eye stands and what it looks at, so that the devices, the tags and the first toss's motion fit in."""
    points = np.vstack(
        [device_places_m(scene), *(t.world_from_tag.translation_m for t in scene.calibration.table_tags)]
    )
    moved = motion_m(scene)
    seen = np.vstack([points, moved if len(moved) else [[0.0, 0.0, 0.1]]])
    target = (seen.min(axis=0) + seen.max(axis=0)) / 2
    along = EYE_FROM_TARGET / np.linalg.norm(EYE_FROM_TARGET)
    nearer = (seen - target) @ along
    aside = np.linalg.norm(seen - target - nearer[:, None] * along, axis=1)
    distance_m = float((nearer + aside / HALF_VIEW).max())
    return target + along * float(np.clip(distance_m, 0.6, 6.0)), target


def motion_m(scene: Scene) -> Float[Array, "n 3"]:
    """Where the object was in the first toss, by the first body that knows."""
    for body in scene.bodies:
        _, matrices = root_poses(scene, body.poses.get(scene.tosses[0], ()))
        known = matrices[np.isfinite(matrices).all(axis=(1, 2)), :3, 3]
        if len(known):
            return known
    return np.zeros((0, 3))


def device_places_m(scene: Scene) -> Float[Array, "n 3"]:
    """Where the cameras are and, for an arm, where its foot and its elbow are, in the root frame."""
    frames = [scene.root_from(camera.frame) for camera in scene.calibration.cameras.values()]
    places = [frame.translation_m for frame in frames if frame is not None]
    root_from_base = scene.root_from(BASE)
    if root_from_base is not None:
        places += [root_from_base.translation_m, root_from_base.translation_m + ELBOW_M]
    return np.array(places, dtype=np.float64).reshape(-1, 3)


def _images(scene: Scene) -> rrb.Container | None:
    """Colour and depth in one row, the ground-truth cameras in the next."""
    cameras = sorted({name for toss in scene.tosses for name in _cameras(scene, toss)})
    mono = [name for name in cameras if _is_mono(scene, name)]
    first = [
        rrb.Spatial2DView(origin=image_entity(scene, c), name=f"Colour of {c}", overrides=_hidden_matches(scene, c))
        for c in cameras
        if c not in mono
    ]
    if any(_has_depth(scene, toss) for toss in scene.tosses):
        first.append(rrb.Spatial2DView(origin=DEPTH.format("d455"), name="Depth"))
    second = [rrb.Spatial2DView(origin=image_entity(scene, name), name=name) for name in mono]
    rows = [rrb.Horizontal(*views) for views in (first, second) if views]
    return rrb.Vertical(*rows, row_shares=[3, 2][: len(rows)], name="Images") if rows else None


def _hidden_matches(scene: Scene, camera: str) -> dict[str, rrb.EntityBehavior]:
    """Matches cover the object: they wait for a click."""
    paths = [MATCHES.format(image_entity(scene, camera), body.name) for body in scene.bodies if body.notes]
    return {path: rrb.EntityBehavior(visible=False) for path in paths}


def _is_mono(scene: Scene, camera: str) -> bool:
    recorded = (scene.toss(toss) for toss in scene.tosses)
    return any(toss is not None and f"/{camera}/image" in toss.file.channels for toss in recorded)


def _cameras(scene: Scene, toss: int) -> tuple[str, ...]:
    recorded = scene.toss(toss)
    return recorded.cameras() if recorded is not None else ()


def _has_depth(scene: Scene, toss: int) -> bool:
    recorded = scene.toss(toss)
    return recorded is not None and len(recorded.depth()) > 0


def _plots(scene: Scene) -> rrb.Container | None:
    recorded = [toss for toss in (scene.toss(i) for i in scene.tosses) if toss is not None]
    plots = []
    if scene.bodies:
        if scene.root == "world":
            plots.append((f"{MOTION}/height_m", "Height (m)"))
        plots += [(f"{MOTION}/speed_m_s", "Speed (m/s)"), (f"{MOTION}/spin_rad_s", "Spin (rad/s)")]
    for name, shown in FIGURE_NAMES.items():
        if any(has_figure(body, name) for body in scene.bodies):
            plots.append((f"{FIGURES}/{name}", shown))
    plots += cycle_plots(scene)
    if any("/arm/joint_states" in toss.file.channels for toss in recorded):
        plots += [(f"{ARM}/angles_rad", "Arm joints (rad)"), (f"{ARM}/speeds_rad_s", "Joint speeds (rad/s)")]
        plots.append((f"{ARM}/finger_width_m", "Gripper (m)"))
    if any(toss.cameras() for toss in recorded):
        plots.append((FRAMES, "Frame gaps (ms)"))
    axis = _plotted_range(scene)
    views = [rrb.TimeSeriesView(origin=origin, name=name, axis_x=axis) for origin, name in plots]
    return rrb.Tabs(*views, name="Plots") if views else None


def has_figure(body: Body, name: str) -> bool:
    """Whether this figure of how a body was tracked is known in any toss."""
    return bool(body.masks if name == "mask_confidence" else body.notes)


def _plotted_range(scene: Scene) -> rrb.TimeAxis | None:
    """A usual toss's length before and after the moment shown: between tosses may lie minutes."""
    if len(scene.tosses) == 1:
        return None
    usual_s = float(np.median([np.diff(scene.spans_ns[toss]) for toss in scene.tosses])) / 1e9
    here = rr.TimeRangeBoundary.cursor_relative
    return rrb.TimeAxis(view_range=rr.TimeRange(here(seconds=-usual_s), here(seconds=usual_s)))


def _words() -> rrb.Container:
    events = rrb.TextLogView(origin="/", contents=[f"+ /{EVENTS}", f"+ /{HEALTH}"], name="Events and health")
    return rrb.Tabs(rrb.TextDocumentView(origin=ABOUT, name="What you see"), events, name="Words")


def about_text(scene: Scene) -> str:
    """What is on the screen, for someone who sees it for the first time (Markdown)."""
    name = scene.session.object_name if scene.session is not None else "the object"
    lines = [f"# {scene.name}", f"{_count(len(scene.tosses))} of **{name}**.", ""]
    if scene.session is not None and scene.session.calibration.cameras:
        lines += ["- **Points**: what the depth camera measured, in its own colours."]
        lines += ["- **Pyramids**: the cameras, with the image each one sees."]
    if scene.calibration.table_tags:
        lines += ["- **Yellow squares**: the table's tags where the calibration has them."]
    if scene.root_from(BASE) is not None:
        lines += ["- **Arm**: moved by its recorded joint angles."]
    if scene.root == "world":
        lines += ["- **Grid**: the plane of the table, a line every 10 cm."]
    for body in scene.bodies:
        hidden = "" if body.shown else " (hidden: click its eye in the list of entities)"
        lines += [f"- **{_color_word(body.color)}**: {body.label}, and its way through the toss{hidden}."]
        lines += _tracking_words(body)
    for body in scene.bodies:
        lines += cycle_words(body)
    lines += [
        "",
        "Space starts and stops. The blue range of the time line is the first toss; drag it to another.",
        "",
    ]
    lines += ["| toss | from (s) | to (s) |", "|---|---|---|"]
    for toss in scene.tosses:
        start, end = ((t + scene.shift_ns[toss]) / 1e9 for t in scene.spans_ns[toss])
        lines += [f"| {toss} | {start:.3f} | {end:.3f} |"]
    if scene.notes:
        lines += ["", "**Not as complete as it could be**", *(f"- {note}" for note in scene.notes)]
    return "\n".join(lines)


def _tracking_words(body: Body) -> list[str]:
    lines = ["- **Tint over the colour image**: the mask it was tracked in."] if body.masks else []
    if not body.notes:
        return lines
    lines += ["- **Second tab in 3D**: what its keyframes had seen of it so far, arrows from where they look."]
    if any(len(n.matches.frames) for n in body.notes.values()):
        lines += [
            "- **Lines in the colour image** (hidden: click their eye in the list of entities): feature matches with a "
            "keyframe, where the tracker looked at any; red ones do not fit the poses."
        ]
    if any(len(n.rejected.frame) for n in body.notes.values()):
        lines += ["- **Grey axes**: poses that were tried and not taken, with what they cost."]
    return lines


def _count(tosses: int) -> str:
    return "One toss" if tosses == 1 else f"{tosses} tosses"


def _color_word(color: tuple[int, int, int]) -> str:
    words = {
        (60, 200, 90): "Green",
        (255, 140, 0): "Orange",
        (220, 60, 180): "Pink",
        (250, 220, 60): "Yellow",
        (120, 120, 255): "Violet",
        (60, 150, 255): "Blue",
    }
    return words.get(color, str(color))
