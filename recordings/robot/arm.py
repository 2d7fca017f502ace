"""A robot arm from its URDF: where its links are for given joint angles, and the meshes that show them.

Plain numpy; the default is the Franka Panda of the package example-robot-data. Finger joints that mimic one another
are set together: `finger_width_m` is the distance between the finger pads (twice the URDF's finger joint).
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import metadata
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.bounded.limits import MOST_JOINTS
from recordings.bounded.xml_file import read_xml
from recordings.errors import BadInput
from recordings.geometry import Transform, rotation_exp
from recordings.records import ArmStates

PANDA_DISTRIBUTION = "example-robot-data"
PANDA_URDF = "panda_description/urdf/panda.urdf"
PANDA_TOOL = "panda_hand_tcp"
COVERED_NS = 50_000_000
"""Joint states may be this far apart, and an instant this far outside of them."""


@dataclass(frozen=True, eq=False)
class Joint:
    """`parent_from_child` = origin, then a turn about `axis` by q (revolute) or a shift along it (prismatic)."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Transform
    axis: Float[Array, "3"]
    lower: float
    upper: float
    fastest: float
    """Speed limit in rad/s or m/s."""

    def parent_from_child(self, q: float) -> Transform:
        if self.kind == "revolute":
            move = Transform(self.child, self.child, rotation_exp(q * self.axis), np.zeros(3))
        elif self.kind == "prismatic":
            move = Transform(self.child, self.child, np.eye(3), q * self.axis)
        else:
            return self.origin
        return self.origin @ move


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """A mesh file that shows (a part of) a link."""

    link: str
    path: Path
    link_from_mesh: Transform


@dataclass(frozen=True, eq=False)
class Robot:
    """A tree of links. `root` is the base; joints come in the URDF's order, parents before children."""

    root: str
    joints: tuple[Joint, ...]
    meshes: tuple[LinkMesh, ...]

    @property
    def arm_joints(self) -> tuple[Joint, ...]:
        """The joints that turn, from the base to the tool."""
        return tuple(j for j in self.joints if j.kind == "revolute")

    def links(self, q_rad: Float[Array, " j"], finger_width_m: float = 0.0) -> dict[str, Transform]:
        """`<root>_from_<link>` of every link; `q_rad` in the order of `arm_joints`."""
        names = [j.name for j in self.arm_joints]
        if len(q_rad) != len(names):
            raise BadInput(f"{len(q_rad)} joint angles for {len(names)} joints ({', '.join(names)})")
        at: Mapping[str, float] = dict(zip(names, (float(q) for q in q_rad)))
        found = {self.root: Transform.identity(self.root, self.root)}
        for joint in self.joints:
            q = at.get(joint.name, finger_width_m / 2)
            found[joint.child] = found[joint.parent] @ joint.parent_from_child(q)
        return found

    def jacobian(self, q_rad: Float[Array, " j"], link: str, point_m: Float[Array, "3"]) -> Float[Array, "6 j"]:
        """Velocity (3) and angular velocity (3), in the root's axes, of a point fixed to `link`, per joint speed.

        `point_m` is given in the root's frame; joints that do not carry the link have zero columns.
        """
        links = self.links(q_rad)
        carrying = self._chain(link)
        columns = []
        for joint in self.arm_joints:
            if joint.name not in carrying:
                columns.append(np.zeros(6))
                continue
            frame = links[joint.child]
            axis = frame.rotation @ joint.axis
            columns.append(np.concatenate([np.cross(axis, point_m - frame.translation_m), axis]))
        return np.stack(columns, axis=1)

    def _chain(self, link: str) -> set[str]:
        above = {j.child: j for j in self.joints}
        names: set[str] = set()
        while link in above:
            names.add(above[link].name)
            link = above[link].parent
        return names


class ArmPath:
    """Where a robot's links were at any time of a toss, from its recorded joint states."""

    def __init__(self, robot: Robot, states: ArmStates) -> None:
        """Raises BadInput where the joints are not this robot's, or there is no state."""
        names = tuple(j.name for j in robot.arm_joints)
        if states.joint_names != names or len(states.time_ns) == 0:
            raise BadInput(
                f"{len(states.time_ns)} joint states of {', '.join(states.joint_names) or 'no joints'}; "
                f"wanted {', '.join(names)}"
            )
        self.robot, self._states = robot, states

    def covers(self, time_ns: int) -> bool:
        """Whether the joints are known at a time: a state lies near on either side of it, or very near on one."""
        times = self._states.time_ns
        right = int(np.searchsorted(times, time_ns))
        before = time_ns - times[right - 1] if right > 0 else COVERED_NS
        after = times[right] - time_ns if right < len(times) else COVERED_NS
        return bool(min(before, after) < COVERED_NS / 2 and (right in (0, len(times)) or before + after < COVERED_NS))

    def q_rad(self, time_ns: int) -> Float[Array, " j"]:
        """Joint angles, linear between two states, held beyond either end."""
        states = self._states
        return np.array([np.interp(time_ns, states.time_ns, q) for q in states.q_rad.T])

    def finger_width_m(self, time_ns: int) -> float:
        """Distance between the finger pads; NaN where the gripper reported none near that time."""
        width, times = self._states.finger_width_m, self._states.time_ns
        known = np.isfinite(width)
        return float(np.interp(time_ns, times[known], width[known])) if known.any() else float("nan")

    def may_hold(self, time_ns: int) -> bool:
        """Whether the fingers are as far apart as at the start (within 3 mm), so that they may hold something."""
        width, first = self.finger_width_m(time_ns), self.finger_width_m(int(self._states.time_ns[0]))
        return not abs(width - first) > 0.003  # a width that nobody knows may hold something

    def links(self, time_ns: int, finger_width_m: float | None = None) -> dict[str, Transform]:
        """`<root>_from_<link>` of every link. A width that nobody knows counts as closed."""
        width = self.finger_width_m(time_ns) if finger_width_m is None else finger_width_m
        return self.robot.links(self.q_rad(time_ns), float(np.nan_to_num(width)))


@cache
def panda() -> Robot:
    """The Franka Panda with its hand. Frames: root `panda_link0`, tool `panda_hand_tcp`."""
    return read_urdf(panda_urdf())


def panda_urdf() -> Path:
    """Where the installed package keeps the Panda's URDF."""
    try:
        files = metadata.distribution(PANDA_DISTRIBUTION).files or []
    except metadata.PackageNotFoundError as missing:
        raise BadInput("the Panda's model is not installed; run `pip install example-robot-data-loaders`") from missing
    for file in files:
        if file.as_posix().endswith(PANDA_URDF):
            return Path(str(file.locate())).resolve()
    raise BadInput(
        f"{PANDA_DISTRIBUTION} holds no {PANDA_URDF}; reinstall it: `pip install example-robot-data-loaders`"
    )


def read_urdf(path: Path) -> Robot:
    """A URDF whose `package://` meshes lie in a folder above it."""
    tree = read_xml(path, "a URDF")
    try:
        return _robot(tree, path)
    except (KeyError, ValueError) as wrong:
        raise BadInput(f"{path}: cannot be read as a URDF ({type(wrong).__name__}: {wrong})") from wrong


def _robot(tree: ET.Element, path: Path) -> Robot:
    nodes = tree.findall("joint")
    if len(nodes) > MOST_JOINTS:
        raise BadInput(f"{path}: {len(nodes)} joints; wanted at most {MOST_JOINTS}")
    joints = _in_order([_joint(node) for node in nodes])
    children = {j.child for j in joints}
    roots = [name for node in tree.findall("link") if (name := node.attrib["name"]) not in children]
    if len(roots) != 1:
        raise BadInput(f"{path}: found {len(roots)} links without a parent ({', '.join(roots[:5])}); wanted one base")
    meshes = [m for node in tree.findall("link") for m in _meshes(node, path)]
    return Robot(roots[0], tuple(joints), tuple(meshes))


def _joint(node: ET.Element) -> Joint:
    parent, child = (_child(node, what).attrib["link"] for what in ("parent", "child"))
    axis, limit = node.find("axis"), node.find("limit")
    bounds = limit.attrib if limit is not None else {}
    return Joint(
        node.attrib["name"],
        node.attrib["type"],
        parent,
        child,
        _origin(node, parent, child),
        _numbers(axis.attrib["xyz"]) if axis is not None else np.array([1.0, 0.0, 0.0]),
        float(bounds.get("lower", "-inf")),
        float(bounds.get("upper", "inf")),
        float(bounds.get("velocity", "inf")),
    )


def _in_order(joints: list[Joint]) -> list[Joint]:
    """Parents before children, otherwise as in the file."""
    ordered: list[Joint] = []
    known = {j.parent for j in joints} - {j.child for j in joints}
    while len(ordered) < len(joints):
        ready = [j for j in joints if j not in ordered and j.parent in known]
        if not ready:
            raise BadInput("the URDF's joints form a loop; wanted a tree")
        ordered += ready
        known |= {j.child for j in ready}
    return ordered


def _meshes(link: ET.Element, urdf: Path) -> list[LinkMesh]:
    found = []
    for visual in link.findall("visual"):
        mesh = visual.find("geometry/mesh")
        if mesh is not None:
            name = link.attrib["name"]
            found.append(LinkMesh(name, _locate(mesh.attrib["filename"], urdf), _origin(visual, name, "mesh")))
    return found


def _locate(name: str, urdf: Path) -> Path:
    relative = name.removeprefix("package://").removeprefix("file://")
    for folder in urdf.parents:
        if (folder / relative).is_file():
            return folder / relative
    raise BadInput(f"{urdf}: mesh {name} is in none of the folders above it")


def _origin(node: ET.Element, target: str, source: str) -> Transform:
    origin = node.find("origin")
    given = origin.attrib if origin is not None else {}
    roll, pitch, yaw = _numbers(given.get("rpy", "0 0 0"))
    turns = [rotation_exp(a * np.eye(3)[k]) for k, a in enumerate((roll, pitch, yaw))]
    return Transform(target, source, turns[2] @ turns[1] @ turns[0], _numbers(given.get("xyz", "0 0 0")))


def _child(node: ET.Element, name: str) -> ET.Element:
    found = node.find(name)
    if found is None:
        raise BadInput(f"URDF: {node.tag} {node.attrib.get('name', '?')} has no {name}")
    return found


def _numbers(text: str) -> Float[Array, "3"]:
    return np.array([float(v) for v in text.split()])
