"""Flight and contact of the released object: MuJoCo with one free body on a plane."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from acquisition.synthetic.config import ContactConfig
from acquisition.synthetic.motion import Release, Trajectory
from acquisition.synthetic.objects.shapes import MassProperties
from acquisition.synthetic.objects.solids import Solid

STILL_M_S, STILL_RAD_S = 0.01, 0.15
STILL_FOR_S = 0.1
SOURCE = "MuJoCo simulation, elliptic friction cone, soft contact with the time constant and damping ratio given here"


class Table:
    """An object ready to be dropped on the plane z = 0."""

    def __init__(self, solid: Solid, mass: MassProperties, contact: ContactConfig) -> None:
        import mujoco

        self._contact = contact
        self._model = mujoco.MjModel.from_xml_string(_describe(solid, mass, contact))
        self._mujoco = mujoco

    def drop(
        self, release: Release, start_s: float, longest_s: float, after_s: float
    ) -> tuple[Trajectory, float, float]:
        """Simulate from the release: the trajectory, the first contact's time and the time of coming to rest.

        Either time is infinite where it does not happen within `longest_s`. Goes on for `after_s` after the rest.
        """
        model, data = self._model, self._mujoco.MjData(self._model)
        data.qpos[:3] = release.world_from_object.translation_m
        data.qpos[3:] = release.world_from_object.quaternion_wxyz
        data.qvel[:3] = release.velocity_world_m_s
        data.qvel[3:] = release.world_from_object.rotation.T @ release.angular_velocity_world_rad_s
        rows, first_impact_s, still_since_s = [], float("inf"), float("inf")
        for _ in range(int((longest_s + after_s) / self._contact.step_s)):
            time_s = start_s + data.time
            rows.append(np.concatenate([[time_s], data.qpos, data.qvel]))
            if data.ncon and first_impact_s == float("inf"):
                first_impact_s = time_s
            still = bool(data.ncon) and _still(data.qvel)
            still_since_s = min(still_since_s, time_s) if still else float("inf")
            if time_s - still_since_s > max(after_s, STILL_FOR_S):
                break
            self._mujoco.mj_step(model, data)
        table = np.array(rows)
        found = Trajectory(table[:, 0], table[:, 1:4], table[:, 4:8], table[:, 8:11], table[:, 11:14])
        return found, first_impact_s, still_since_s


def _still(velocity: Float[Array, "6"]) -> bool:
    return bool(np.linalg.norm(velocity[:3]) < STILL_M_S and np.linalg.norm(velocity[3:]) < STILL_RAD_S)


def _describe(solid: Solid, mass: MassProperties, contact: ContactConfig) -> str:
    """The scene in MuJoCo's XML. Masses are given, not taken from the geoms."""
    inertia = mass.inertia_kgm2
    full = " ".join(f"{v:.9e}" for v in (*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]))
    pieces = list(_pieces(solid))
    meshes = "".join(f'<mesh name="p{k}" vertex="{text}"/>' for k, text in enumerate(pieces))
    geoms = "".join(f'<geom type="mesh" mesh="p{k}"/>' for k in range(len(pieces)))
    return f"""
<mujoco>
  <option timestep="{contact.step_s}" gravity="0 0 {-contact.gravity_m_s2}" cone="elliptic" impratio="10"/>
  <default><geom friction="{contact.friction} {contact.torsional_friction_m} 0.0001" condim="4"
    solref="{contact.time_constant_s} {contact.damping_ratio}" mass="0"/></default>
  <asset>{meshes}</asset>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body><freejoint/>
      <inertial pos="{_numbers(mass.center_m)}" mass="{mass.mass_kg}" fullinertia="{full}"/>{geoms}
    </body>
  </worldbody>
</mujoco>"""


def _pieces(solid: Solid) -> Iterator[str]:
    for piece in solid.pieces_m:
        yield _numbers(piece.ravel())


def _numbers(values: Float[Array, " n"]) -> str:
    return " ".join(f"{v:.7g}" for v in values)
