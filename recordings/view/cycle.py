"""The cycle in rerun: each pass's poses and shapes, how the shape was laid onto raw depth, the learned model's ghost.

Drawn for the shown body from what its results folder still holds; what it does not hold is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray as Array
from scipy.spatial import cKDTree

from recordings.tracks import ObjectShape, ObjectTrack
from recordings.view.bodies import unbroken
from recordings.view.cycle_steps import Judged, Laid, Rollout, Step, TossCycle
from recordings.view.layers import EVENTS, Clock, plotted, quaternions_xyzw
from recordings.view.mesh import shaded_mesh, smooth_mesh, vertex_normals
from recordings.view.scene import Body, Color, Scene

PASS, GHOST, STEPS = "world/passes/{}/{}", "world/ghost/{}", "steps/{}"
REJECTED, FIGURES = "world/icp_rejected/{}", "cycle"
EARLIER: tuple[Color, ...] = ((150, 185, 215), (190, 190, 110), (110, 200, 190), (215, 150, 215))
GHOST_COLOR: Color = (235, 235, 235)
WARNING: Color = (235, 70, 70)
SOLID, GHOSTLY = 150, 80
FULL_M = 0.003
"""A surface moved by this much has the full colour: red outwards, blue inwards."""
NOWHERE = 1e-6
"""A body is drawn this small while it has no pose: its mesh stays, which is large to log again."""
SPACING = 1.5
"""Distance of shapes side by side, in their largest size."""
FIGURE_NAMES = {
    "icp_mm": "Raw depth to the drawn shape, D to D'' (mm)",
    "icp_fitness": "Raw depth on the drawn shape (share)",
    "depth_mm": "Raw depth to each pass's shape (mm)",
    "outline": "Outline of each pass (1 - IoU)",
    "colour": "Colour of each pass (grey levels)",
    "ghost_mm": "Rollout to track (mm)",
}


@dataclass(frozen=True, eq=False)
class Shown:
    """One shape of a pass as it is listed: `name` for its entity, `label` for people."""

    name: str
    label: str
    shape: ObjectShape
    color: Color


def log_cycle(clock: Clock, scene: Scene, body: Body) -> None:
    """Every layer of the cycle in one toss."""
    cycle = body.cycle.get(clock.toss)
    if cycle is None:
        return
    start_ns = scene.spans_ns[clock.toss][0]
    log_shapes(clock, scene, body, start_ns)
    for i, step in enumerate(cycle.steps):
        color = color_of(body, i, len(cycle.steps))
        log_pass(clock, scene, body, step, color, start_ns)
        log_judged(clock, body, step, color)
        if step.drawn is not None and step.laid is not None:
            log_laid(clock, scene, body, step, step.drawn, step.laid, cycle.steps[i + 1].label)
    if cycle.rollout is not None:
        log_ghost(clock, scene, body, cycle.rollout, cycle.steps[-1].track, start_ns)


def slug(label: str) -> str:
    return label.replace(" ", "_")


def color_of(body: Body, index: int, count: int) -> Color:
    """The last pass has the body's own colour."""
    return body.color if index == count - 1 else EARLIER[index % len(EARLIER)]


def shown_shapes(body: Body, cycle: TossCycle) -> list[Shown]:
    """Vision's and contact's shape of every pass, in the order they were made."""
    found = []
    for i, step in enumerate(cycle.steps):
        color = color_of(body, i, len(cycle.steps))
        for kind, shape in (("vision", step.shape), ("contact", step.learned)):
            if shape is not None:
                what = f"{step.label}: {'corrected by contact' if kind == 'contact' else 'vision'}"
                found.append(Shown(f"{slug(step.label)}/{kind}", what, shape, color))
    return found


def log_shapes(clock: Clock, scene: Scene, body: Body, start_ns: int) -> None:
    """The meshes of every pass, at its poses and side by side: logged again only where a toss has others."""
    before = [t for t in scene.tosses[: scene.tosses.index(clock.toss)] if t in body.cycle]
    last = {s.name: s.shape for s in shown_shapes(body, body.cycle[before[-1]])} if before else {}
    cycle, shapes = body.cycle[clock.toss], shown_shapes(body, body.cycle[clock.toss])
    rollout = cycle.rollout
    if rollout is not None and rollout.shape is not None:
        earlier = body.cycle[before[-1]].rollout if before else None
        if earlier is None or earlier.shape is not rollout.shape:
            mesh = shaded_mesh(rollout.shape, (*GHOST_COLOR, GHOSTLY))
            clock.at(start_ns).log(f"{GHOST.format(body.name)}/object/shape", mesh)
    if all(last.get(s.name) is s.shape for s in shapes) and len(last) == len(shapes):
        return
    step_m = SPACING * max((float(np.ptp(s.shape.vertices_m, axis=0).max()) for s in shapes), default=0.0)
    for i, shown in enumerate(shapes):
        name, kind = shown.name.split("/")
        mesh = shaded_mesh(shown.shape, (*shown.color, SOLID))
        clock.at(start_ns).log(f"{PASS.format(body.name, name)}/object/{kind}", mesh)
        entity = f"{STEPS.format(body.name)}/{shown.name}"
        clock.at(start_ns).log(entity, rr.Transform3D(translation=[i * step_m, 0, 0]))
        clock.at(start_ns).log(f"{entity}/shape", compared_mesh(shown.shape, shapes[0].shape))
        below = [float(shown.shape.vertices_m[:, 0].mean()), float(shown.shape.vertices_m[:, 1].max()) + 0.02, 0.0]
        clock.at(start_ns).log(f"{entity}/name", rr.Points3D([below], labels=[shown.label], radii=0.0005))


def compared_mesh(shape: ObjectShape, first: ObjectShape) -> rr.Mesh3D:
    """A shape coloured by where it lies outside (red) or inside (blue) of the first one; that one is grey."""
    gap = np.zeros(len(shape.vertices_m)) if shape is first else gap_m(shape, first)
    return smooth_mesh(shape, vertex_colors=gap_colors(gap))


def gap_m(shape: ObjectShape, first: ObjectShape) -> Float[Array, " v"]:
    """How far each vertex lies outside (+) of the first surface: its distance to the plane at that one's nearest vertex
    (field meshes are dense), in metres."""
    at = cKDTree(first.vertices_m).query(shape.vertices_m)[1]
    normals = vertex_normals(first.vertices_m, first.faces)
    return np.asarray(((shape.vertices_m - first.vertices_m[at]) * normals[at]).sum(1))


def gap_colors(gap: Float[Array, " n"]) -> UInt8[Array, "n 3"]:
    """Grey where nothing moved, towards red outwards and blue inwards."""
    share = np.clip(gap / FULL_M, -1, 1)[:, None]
    grey, out, inside = (np.array(c, dtype=np.float64) for c in ((200, 200, 200), (225, 50, 40), (40, 90, 225)))
    mixed = grey + np.maximum(share, 0) * (out - grey) + np.maximum(-share, 0) * (inside - grey)
    return mixed.round().astype(np.uint8)


def root_from_object(scene: Scene, track: ObjectTrack) -> Float[Array, "n 4 4"]:
    """Poses in the frame that is drawn in, NaN where lost; none where the camera's place is not known."""
    place = scene.root_from(track.camera)
    return np.zeros((0, 4, 4)) if place is None else np.asarray(place.matrix @ track.camera_from_object)


def log_pass(clock: Clock, scene: Scene, body: Body, step: Step, color: Color, start_ns: int) -> None:
    """The way of one pass through the toss, and its moving body (whose meshes lie below it)."""
    entity, poses = PASS.format(body.name, slug(step.label)), root_from_object(scene, step.track)
    paths = rr.LineStrips3D(unbroken(poses[:, :3, 3]), colors=[color], radii=0.0007)
    clock.at(start_ns).log(f"{entity}/path", paths)
    move(clock, f"{entity}/object", start_ns, step.track.time_ns, poses)


def move(clock: Clock, entity: str, start_ns: int, times_ns: Int64[Array, " n"], poses: Float[Array, "n 4 4"]) -> None:
    """A body at its poses; too small to be seen before them and where it has none."""
    if len(poses) == 0:
        return
    known = np.isfinite(poses).all(axis=(1, 2))
    placed = np.where(known[:, None, None], poses, np.eye(4))
    turned = quaternions_xyzw(placed[:, :3, :3])
    size = np.where(known, 1.0, NOWHERE)
    if times_ns[0] > start_ns:
        clock.at(start_ns).log(entity, rr.Transform3D(translation=[0, 0, 0], scale=NOWHERE))
    columns = rr.Transform3D.columns(
        translation=placed[:, :3, 3], quaternion=turned, scale=np.repeat(size[:, None], 3, axis=1)
    )
    clock.columns(entity, times_ns, columns)


def log_judged(clock: Clock, body: Body, step: Step, color: Color) -> None:
    """How badly a pass explains the raw images, frame by frame; also with contact's shape at the same poses."""
    for judged, kind in ((step.judged, ""), (step.judged_learned, ", contact's shape")):
        if judged is None or len(judged.position) == 0:
            continue
        times_ns = step.track.time_ns[judged.position]
        dimmed: Color = color if not kind else (color[0] // 2, color[1] // 2, color[2] // 2)
        figures = {"depth_mm": 1e3 * judged.depth_m, "outline": judged.mask, "colour": judged.color}
        for name, values in figures.items():
            log_line(
                clock, f"{name}/{body.name}/{slug(step.label + kind)}", step.label + kind, dimmed, times_ns, values
            )


def log_line(
    clock: Clock, entity: str, label: str, color: Color, times_ns: Int64[Array, " n"], values: Float[Array, " n"]
) -> None:
    """Numbers over time as a line of a plot."""
    path = f"{FIGURES}/{entity}"
    clock.at(int(times_ns[0])).log(path, rr.SeriesLines(names=[label], colors=[color]), static=True)
    clock.columns(path, *plotted(times_ns, values))


def log_laid(clock: Clock, scene: Scene, body: Body, step: Step, drawn: ObjectTrack, laid: Laid, into: str) -> None:
    """The residual of D to D'' per frame, and ICP's rejections: in the plot, in 3D and among the events."""
    times_ns, label = drawn.time_ns, f"drawn for {into}"
    if len(times_ns) != len(laid.verdict) or len(times_ns) == 0:
        return
    log_line(clock, f"icp_mm/{body.name}/{slug(into)}", label, body.color, times_ns, 1e3 * laid.rmse_m)
    log_line(clock, f"icp_fitness/{body.name}/{slug(into)}", label, body.color, times_ns, laid.fitness)
    refused = np.flatnonzero(laid.rejected)
    log_refused(clock, scene, body, drawn, laid, refused)
    if len(refused) == 0:
        return
    entity = f"{FIGURES}/icp_mm/{body.name}/{slug(into)}_rejected"
    style = rr.SeriesPoints(names=["rejected"], colors=[WARNING], markers=["cross"], marker_sizes=[6.0])
    clock.at(int(times_ns[0])).log(entity, style, static=True)
    heights = np.nan_to_num(1e3 * laid.rmse_m[refused])
    clock.columns(entity, times_ns[refused], rr.Scalars.columns(scalars=heights))
    for i in refused:
        text = f"toss {clock.toss}, frame {i}, {label}: ICP's correction is rejected: {laid.verdict[i]}"
        clock.at(int(times_ns[i])).log(EVENTS, rr.TextLog(text, level=rr.TextLogLevel.WARN))


def log_refused(
    clock: Clock, scene: Scene, body: Body, drawn: ObjectTrack, laid: Laid, refused: Int64[Array, " r"]
) -> None:
    """A red point with ICP's verdict where the object is in a rejected frame, and nothing in the others."""
    entity, poses = REJECTED.format(body.name), root_from_object(scene, drawn)
    clock.at(int(drawn.time_ns[0])).log(entity, rr.Clear(recursive=True))
    for i in refused if len(poses) else ():
        if not np.isfinite(poses[i]).all():
            continue
        point = rr.Points3D([poses[i, :3, 3]], colors=[WARNING], radii=0.006, labels=[f"ICP: {laid.verdict[i]}"])
        clock.at(int(drawn.time_ns[i])).log(entity, point)
        if i + 1 < len(drawn.time_ns):
            clock.at(int(drawn.time_ns[i + 1])).log(entity, rr.Clear(recursive=True))


def log_ghost(clock: Clock, scene: Scene, body: Body, rollout: Rollout, track: ObjectTrack, start_ns: int) -> None:
    """The learned model let go at the release: its body, its way, and how far it is from the track."""
    place = scene.root_from("world")
    if place is None or len(rollout.time_ns) == 0:
        return
    entity, poses = GHOST.format(body.name), place.matrix @ rollout.world_from_object
    path = rr.LineStrips3D(unbroken(poses[:, :3, 3]), colors=[GHOST_COLOR], radii=0.0007)
    clock.at(start_ns).log(f"{entity}/path", path)
    end_ns = max(int(track.time_ns[-1]), int(rollout.time_ns[0]))
    during = rollout.time_ns <= end_ns
    times_ns = np.append(rollout.time_ns[during], end_ns + 1)
    gone = np.full((1, 4, 4), np.nan)
    move(clock, f"{entity}/object", start_ns, times_ns, np.concatenate([poses[during], gone]))
    tracked = root_from_object(scene, track)
    at_ns, distance_m = distances_m(rollout.time_ns, poses, track.time_ns, tracked)
    if len(at_ns):
        log_line(clock, f"ghost_mm/{body.name}", "rollout to track", body.color, at_ns, 1e3 * distance_m)


def distances_m(
    times_ns: Int64[Array, " t"],
    poses: Float[Array, "t 4 4"],
    track_ns: Int64[Array, " n"],
    tracked: Float[Array, "n 4 4"],
) -> tuple[Int64[Array, " k"], Float[Array, " k"]]:
    """Distance of the origins at the track's frames that the rollout covers, straight between its steps."""
    if len(tracked) == 0:
        return track_ns[:0], np.zeros(0)
    covered = (track_ns >= times_ns[0]) & (track_ns <= times_ns[-1]) & np.isfinite(tracked[:, 0, 3])
    at_ns = track_ns[covered]
    places = np.stack([np.interp(at_ns, times_ns, poses[:, k, 3]) for k in range(3)], axis=-1)
    return at_ns, np.linalg.norm(places - tracked[covered, :3, 3], axis=1)


def bodies_with_cycle(scene: Scene) -> list[Body]:
    return [body for body in scene.bodies if body.shown and body.cycle]


def hidden_entities(scene: Scene) -> list[str]:
    """Bodies and ways of single passes lie over the result: they wait for a click."""
    return [
        f"{PASS.format(body.name, slug(label))}/object"
        for body in bodies_with_cycle(scene)
        for label in labels_of(body)
    ]


def labels_of(body: Body) -> list[str]:
    """Names of the passes that any toss has, in their order."""
    return list(dict.fromkeys(step.label for cycle in body.cycle.values() for step in cycle.steps))


def step_views(scene: Scene) -> list[rrb.Spatial3DView]:
    """A tab with the shapes of all passes side by side, in the object's frame."""
    views = []
    for body in bodies_with_cycle(scene):
        shapes = shown_shapes(body, next(iter(body.cycle.values())))
        if len(shapes) < 2:
            continue
        size = max(float(np.ptp(s.shape.vertices_m, axis=0).max()) for s in shapes)
        middle = shapes[0].shape.vertices_m.mean(0) + [SPACING * size * (len(shapes) - 1) / 2, 0, 0]
        away = np.array([0.0, -0.6, -1.0]) * size * max(2.0, 1.25 * len(shapes))
        eye = rrb.EyeControls3D(position=middle + away, look_target=middle, eye_up=[0, -1, 0])
        grid = rrb.LineGrid3D(visible=False)
        name = "The shape, step by step"
        views.append(rrb.Spatial3DView(origin=STEPS.format(body.name), name=name, line_grid=grid, eye_controls=eye))
    return views


def cycle_plots(scene: Scene) -> list[tuple[str, str]]:
    """Entity and title of every plot that has a line."""
    known = {name for body in bodies_with_cycle(scene) for name in figures_known(body)}
    return [(f"{FIGURES}/{name}", title) for name, title in FIGURE_NAMES.items() if name in known]


def figures_known(body: Body) -> Iterator[str]:
    for cycle in body.cycle.values():
        if cycle.rollout is not None:
            yield "ghost_mm"
        for step in cycle.steps:
            if step.laid is not None:
                yield from ("icp_mm", "icp_fitness")
            if step.judged is not None:
                yield from ("depth_mm", "outline", "colour")


def cycle_words(body: Body) -> list[str]:
    """What the layers are, and each pass in numbers (Markdown)."""
    if not body.cycle:
        return []
    labels, cycles = labels_of(body), list(body.cycle.values())
    lines = []
    if len(labels) > 1:
        lines += [f"- **Thin lines**: the ways of {', '.join(labels)}; their bodies are hidden (click their eye)."]
    if any(c.rollout for c in cycles):
        lines += ["- **White ghost**: the learned contact model, let go at the release and left to itself."]
    if len(shown_shapes(body, cycles[0])) > 1:
        lines += [
            "- **Tab `The shape, step by step`**: grey is the first shape; red lies outside of it, blue inside "
            f"(full colour: {1e3 * FULL_M:.0f} mm)."
        ]
    if any(step.laid for c in cycles for step in c.steps):
        lines += ["- **Red points and crosses**: frames in which ICP's correction was rejected."]
    return [*lines, *_passes_table(cycles, labels)]


def _passes_table(cycles: Sequence[TossCycle], labels: Sequence[str]) -> list[str]:
    rows = []
    for label in labels:
        steps = [s for c in cycles for s in c.steps if s.label == label]
        rejected: Bool[Array, " n"] = np.concatenate([np.zeros(0, bool), *(s.laid.rejected for s in steps if s.laid)])
        laid = f"{int(rejected.sum())} of {len(rejected)}" if len(rejected) else "-"
        lost = sum(status == "lost" for s in steps for status in s.track.status)
        for kind, judged in (("", [s.judged for s in steps]), (", contact's shape", [s.judged_learned for s in steps])):
            known = [j for j in judged if j is not None]
            if kind and not known:
                continue
            figures = (_mean(known, lambda j: 1e3 * j.depth_m), _mean(known, lambda j: j.mask))
            counts = ("", "") if kind else (str(lost), laid)
            rows.append(f"| {label}{kind} | {figures[0]} | {figures[1]} | {counts[0]} | {counts[1]} |")
    head = "| pass | raw depth (mm) | outline (1 - IoU) | lost frames | rejected by ICP after it |"
    return ["", head, "|---|---|---|---|---|", *rows] if rows else []


def _mean(judged: Sequence[Judged], value: Callable[[Judged], Array]) -> str:
    values = np.concatenate([value(j) for j in judged]) if judged else np.zeros(0)
    return f"{np.nanmean(values):.3f}" if np.isfinite(values).any() else "-"
