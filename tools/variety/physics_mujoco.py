"""The first engine: MuJoCo's soft contact, with the damping that gives a wanted restitution, and drag."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from acquisition.synthetic.motion import Release
from variety.physics import AIR_KG_M3, STILL_FOR_S, Fall, Ground, Thrown, com_state, of_mesh, still_since

STEP_S = 0.0005
STIFFNESS_S2 = 200_000.0
"""Of the contact's spring, per mass: the reference acceleration is -b v - k r."""
TRIAL_M_S = 1.0


class MuJoCo:
    """The engine that the quick generator also uses, here with restitution and air."""

    name = "MuJoCo, elliptic cone, spring contact, 0.5 ms"

    def drop(
        self, body: Thrown, ground: Ground, release: Release, start_s: float, longest_s: float, after_s: float
    ) -> Fall:
        import mujoco

        model = mujoco.MjModel.from_xml_string(_described(body, ground))
        data = mujoco.MjData(model)
        com, velocity = com_state(release, body.mass.center_m)
        data.qpos[:3], data.qpos[3:] = com, release.world_from_object.quaternion_wxyz
        data.qvel[:3] = velocity
        data.qvel[3:] = release.world_from_object.rotation.T @ release.angular_velocity_world_rad_s
        rows, impact, slow_s = [], float("inf"), 0.0
        for _ in range(int((longest_s + after_s) / STEP_S)):
            rows.append(np.concatenate([[data.time], data.qpos, data.qvel]))
            if data.ncon and impact == float("inf"):
                impact = float(data.time)
            speed = float(np.linalg.norm(data.qvel[:3]))
            slow = bool(data.ncon) and speed < 0.01 and float(np.linalg.norm(data.qvel[3:])) < 0.15
            slow_s = slow_s + STEP_S if slow else 0.0
            if slow_s > max(after_s, STILL_FOR_S):
                break
            data.xfrc_applied[1, :3] = -0.5 * AIR_KG_M3 * body.drag_area_m2 * speed * data.qvel[:3]
            mujoco.mj_step(model, data)
        table = np.array(rows)
        times = start_s + table[:, 0]
        path = of_mesh(body.mass.center_m, times, table[:, 1:4], table[:, 4:8], table[:, 8:11], table[:, 11:14])
        speeds = np.linalg.norm(table[:, 8:11], axis=1), np.linalg.norm(table[:, 11:14], axis=1)
        return Fall(path, start_s + impact, still_since(*speeds, times))


def _described(body: Thrown, ground: Ground) -> str:
    """The scene in MuJoCo's XML, the body's frame at its centre of mass."""
    inertia = body.mass.inertia_kgm2
    full = " ".join(f"{v:.9e}" for v in (*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]))
    corners = " ".join(f"{v:.7g}" for v in (body.hull_m - body.mass.center_m).ravel())
    gravity = " ".join(f"{v:.9g}" for v in ground.gravity_m_s2)
    return f"""
<mujoco>
  <option timestep="{STEP_S}" gravity="{gravity}" cone="elliptic" impratio="10" integrator="RK4"/>
  <default><geom friction="{ground.friction} 0.0005 {ground.rolling_m}" condim="6" mass="0"
    solref="{-STIFFNESS_S2} {-damping_of(ground.restitution)}" solimp="0.95 0.99 0.001"/></default>
  <asset><mesh name="hull" vertex="{corners}"/></asset>
  <worldbody>
    <geom type="plane" size="5 5 0.1"/>
    <body><freejoint/>
      <inertial pos="0 0 0" mass="{body.mass.mass_kg}" fullinertia="{full}"/><geom type="mesh" mesh="hull"/>
    </body>
  </worldbody>
</mujoco>"""


@lru_cache(maxsize=64)
def damping_of(restitution: float) -> float:
    """The damping with which a ball that falls at 1 m/s leaves with the wanted share of its speed, by bisection."""
    low, high = 0.0, 4 * np.sqrt(STIFFNESS_S2)
    for _ in range(16):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if bounced(middle) > restitution else (low, middle)
    return 0.5 * (low + high)


@lru_cache(maxsize=1024)
def bounced(damping: float) -> float:
    """Upward speed after a ball hits the plane at TRIAL_M_S with this damping, as a share of TRIAL_M_S."""
    import mujoco

    model = mujoco.MjModel.from_xml_string(f"""
<mujoco><option timestep="{STEP_S}" gravity="0 0 0" integrator="RK4"/>
  <default><geom solref="{-STIFFNESS_S2} {-damping}" solimp="0.95 0.99 0.001"/></default>
  <worldbody><geom type="plane" size="5 5 0.1"/>
    <body pos="0 0 0.0301"><freejoint/><geom type="sphere" size="0.03" mass="0.1"/></body></worldbody>
</mujoco>""")
    data = mujoco.MjData(model)
    data.qvel[2] = -TRIAL_M_S
    for _ in range(int(0.08 / STEP_S)):
        mujoco.mj_step(model, data)
    return max(0.0, float(data.qvel[2])) / TRIAL_M_S
