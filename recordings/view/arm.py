"""The robot's arm in rerun: its links' meshes, moved by the recorded joint states."""

from __future__ import annotations

import numpy as np
import rerun as rr
from jaxtyping import Int64
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.records import ArmStates
from recordings.robot.arm import LinkMesh, Robot, panda
from recordings.robot.collada import read_collada
from recordings.view.layers import Clock, quaternions_xyzw
from recordings.view.mesh import flat_mesh
from recordings.view.scene import Scene

ROBOT = "world/arm"
PERIOD_NS = 33_333_333
"""The arm is drawn at about the cameras' rate; the plots show every sample."""
BASE = "base"
BRIGHTNESS = 200
"""Of white: the points that were measured on the arm stay visible."""


def log_arm_model(recording: rr.RecordingStream, robot: Robot) -> None:
    """The meshes of every link, once."""
    for number, mesh in enumerate(robot.meshes):
        recording.log(f"{ROBOT}/{mesh.link}/mesh_{number}", link_mesh(mesh), static=True)


def log_arm_motion(recording: rr.RecordingStream, scene: Scene, robot: Robot, toss: int) -> None:
    """Where every link was, by forward kinematics of the joint states nearest to each drawn instant."""
    root_from_base, recorded = scene.root_from(BASE), scene.toss(toss)
    states = recorded.arm_states() if recorded is not None else None
    if root_from_base is None or states is None or not moves(robot, states):
        return
    clock = Clock(recording, toss, scene.shift_ns[toss])
    samples = thinned(states.time_ns)
    root_from_link = [links_at(robot, states, int(i), root_from_base) for i in samples]
    for link in {mesh.link for mesh in robot.meshes}:
        places = [links[link] for links in root_from_link]
        turned = quaternions_xyzw(np.array([p.rotation for p in places]))
        columns = rr.Transform3D.columns(translation=[p.translation_m for p in places], quaternion=turned)
        clock.columns(f"{ROBOT}/{link}", states.time_ns[samples], columns)


def known_arm(scene: Scene) -> Robot | None:
    """The Panda where a toss was recorded with it; None for another arm, none, or one whose place is not known."""
    if scene.root_from(BASE) is None:
        return None
    for index in scene.tosses:
        recorded = scene.toss(index)
        states = recorded.arm_states() if recorded is not None else None
        if states is not None:
            try:
                robot = panda()
            except BadInput:
                return None  # its model is an own package: the session is shown without it
            return robot if moves(robot, states) else None
    return None


def moves(robot: Robot, states: ArmStates) -> bool:
    """Whether the recorded joints are this robot's, in its order."""
    return tuple(joint.name for joint in robot.arm_joints) == states.joint_names and len(states.time_ns) > 0


def thinned(times_ns: Int64[Array, " n"]) -> Int64[Array, " m"]:
    """Positions of the samples nearest to instants PERIOD_NS apart."""
    instants = np.arange(times_ns[0], times_ns[-1] + 1, PERIOD_NS)
    return np.unique(np.minimum(np.searchsorted(times_ns, instants), len(times_ns) - 1))


def links_at(robot: Robot, states: ArmStates, sample: int, root_from_base: Transform) -> dict[str, Transform]:
    """`root_from_<link>` of every link at one sample; a gripper that did not report counts as closed."""
    width_m = float(np.nan_to_num(states.finger_width_m[sample]))
    base_from_robot = Transform.identity(BASE, robot.root)
    links = robot.links(states.q_rad[sample], width_m)
    return {name: root_from_base @ base_from_robot @ place for name, place in links.items()}


def link_mesh(mesh: LinkMesh) -> rr.Mesh3D:
    """A link's mesh in the link's frame, each face in its own colour."""
    colored = read_collada(mesh.path)
    rgb = np.repeat(np.round(colored.face_rgb * BRIGHTNESS).astype(np.uint8), 3, axis=0)
    return flat_mesh(mesh.link_from_mesh.points(colored.vertices_m), colored.faces, vertex_colors=rgb)
