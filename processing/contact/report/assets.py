"""The learned object as simulation-ready assets: URDF, MJCF, Drake SDFormat, each a folder with its meshes.

Friction against a ground: simulators combine two coefficients in their own ways (MuJoCo takes the larger one unless a
geom has priority, PyBullet multiplies, Drake takes 2ab/(a+b)). What was learned is the effective one, so the MJCF gives
the object priority, the URDF wants a ground of 1.0 and the SDFormat a ground of the same coefficient; each file
says so.
"""

from __future__ import annotations

from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from processing.contact.physics.geometry import hull_mesh
from recordings.results.shape_file import obj_text
from recordings.tracks import ContactModel, ObjectShape

ASSETS = "assets"


def write_assets(folder: Path, model: ContactModel, shape: ObjectShape, name: str = "object") -> dict[str, Path]:
    """Write `assets/{urdf,mjcf,drake-sdf}/` into a stage's folder; returns the main file of each."""
    made = {}
    for format_name, suffix, text in (
        ("urdf", ".urdf", urdf_text),
        ("mjcf", ".xml", mjcf_text),
        ("drake-sdf", ".sdf", sdf_text),
    ):
        out = folder / ASSETS / format_name
        out.mkdir(parents=True, exist_ok=True)
        meshes = _write_meshes(out, model, shape, name)
        made[format_name] = out / f"{name}{suffix}"
        made[format_name].write_text(text(model, name, meshes))
    return made


def _write_meshes(folder: Path, model: ContactModel, shape: ObjectShape, name: str) -> list[str]:
    """`<name>.obj` to look at, `<name>_piece<i>.obj` convex ones to touch with; returns the pieces' names."""
    plain = ObjectShape(
        shape.object_frame, shape.source, shape.vertices_m, shape.faces
    )  # MuJoCo refuses vertex colours
    (folder / f"{name}.obj").write_text(obj_text(plain))
    names = []
    for i, piece in enumerate(model.pieces):
        vertices, faces = hull_mesh(model.support_vertices_m[list(piece)])
        names.append(f"{name}_piece{i}.obj")
        (folder / names[-1]).write_text(obj_text(ObjectShape(model.object_frame, "contact", vertices, faces)))
    return names


def _numbers(values: Float[Array, "*n"]) -> str:
    return " ".join(f"{float(v):.9g}" for v in np.ravel(values))


def _inertia_attributes(inertia: Float[Array, "3 3"]) -> str:
    names = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    return " ".join(f'{n}="{inertia[i, j]:.9g}"' for n, i, j in names)


def urdf_text(model: ContactModel, name: str, meshes: list[str]) -> str:
    """URDF with one link. The `contact` element is PyBullet's."""
    collisions = "".join(f'    <collision><geometry><mesh filename="{m}"/></geometry></collision>\n' for m in meshes)
    return f"""<?xml version="1.0"?>
<!-- Learned effective friction {model.friction:.4f}; PyBullet multiplies: use a ground of lateral friction 1.0. -->
<robot name={quoteattr(name)}>
  <link name={quoteattr(name)}>
    <contact><lateral_friction value="{model.friction:.9g}"/></contact>
    <inertial>
      <origin xyz="{_numbers(model.center_of_mass_m)}"/>
      <mass value="{model.mass_kg:.9g}"/>
      <inertia {_inertia_attributes(model.inertia_kgm2)}/>
    </inertial>
    <visual><geometry><mesh filename="{name}.obj"/></geometry></visual>
{collisions}  </link>
</robot>
"""


def mjcf_text(model: ContactModel, name: str, meshes: list[str]) -> str:
    """MJCF with one free body. Include it in a scene with a plane."""
    inertia = model.inertia_kgm2
    full = _numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])
    assets = "".join(f'    <mesh name="{m[:-4]}" file="{m}"/>\n' for m in meshes)
    geoms = "".join(
        f'      <geom class="touch" type="mesh" mesh="{m[:-4]}" friction="{model.friction:.9g} 0.0001 0.00001"/>\n'
        for m in meshes
    )
    return f"""<mujoco model={quoteattr(name)}>
  <!-- Learned effective friction {model.friction:.4f}; priority 1 makes it hold against any ground. -->
  <compiler angle="radian"/>
  <option cone="elliptic"/>
  <default><default class="touch"><geom group="3" priority="1" condim="3"/></default></default>
  <asset>
    <mesh name="{name}" file="{name}.obj" inertia="shell"/>
{assets}  </asset>
  <worldbody>
    <body name={quoteattr(name)}>
      <freejoint/>
      <inertial pos="{_numbers(model.center_of_mass_m)}" mass="{model.mass_kg:.9g}" fullinertia="{full}"/>
      <geom type="mesh" mesh="{name}" contype="0" conaffinity="0" group="2"/>
{geoms}    </body>
  </worldbody>
</mujoco>
"""


def sdf_text(model: ContactModel, name: str, meshes: list[str]) -> str:
    """SDFormat with Drake's proximity properties."""
    inertia = "".join(
        f"<{n}>{model.inertia_kgm2[i, j]:.9g}</{n}>"
        for n, i, j in (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    )
    collisions = "".join(
        f"""      <collision name="piece{i}">
        <geometry><mesh><uri>{m}</uri><drake:declare_convex/></mesh></geometry>
        <drake:proximity_properties>
          <drake:mu_dynamic>{model.friction:.9g}</drake:mu_dynamic>
          <drake:mu_static>{model.friction:.9g}</drake:mu_static>
        </drake:proximity_properties>
      </collision>
"""
        for i, m in enumerate(meshes)
    )
    return f"""<?xml version="1.0"?>
<!-- Learned effective friction {model.friction:.4f}; Drake takes 2ab/(a+b): use a ground of the same coefficient. -->
<sdf xmlns:drake="http://drake.mit.edu" version="1.7">
  <model name={quoteattr(name)}>
    <link name={quoteattr(name)}>
      <inertial>
        <pose>{_numbers(model.center_of_mass_m)} 0 0 0</pose>
        <mass>{model.mass_kg:.9g}</mass>
        <inertia>{inertia}</inertia>
      </inertial>
      <visual name="visual"><geometry><mesh><uri>{name}.obj</uri></mesh></geometry></visual>
{collisions}    </link>
  </model>
</sdf>
"""
