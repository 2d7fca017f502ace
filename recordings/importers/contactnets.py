"""`toss-session import contactnets`: toss files of ContactNets and dair_pll (poses only), for contact learning alone.

What the columns mean is checked against the numbers themselves: positions against velocities (step), quaternions
against spins (order), free fall against gravity (scale). What was found is kept in the start document, `import.checks`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray as Array

from recordings.constants import GRAVITY_M_S2
from recordings.errors import BadInput
from recordings.geometry import Transform
from recordings.importers import common
from recordings.importers.common import ImportReport, Warnings
from recordings.importers.contactnets_checks import Checks, States, check_all, duplicates
from recordings.importers.torch_file import read_tensor
from recordings.progress import Progress, Silent
from recordings.records import StampedPose
from recordings.session_writer import NO_CALIBRATION, SessionWriter

PUBLISHED = "tosses_processed"
"""The folder that params_processed belongs to: taken when a parent holds several folders of tosses."""


@dataclass(frozen=True)
class _Columns:
    """Where a format keeps what. `si`: metres already, so no scale is needed."""

    position: int
    quaternion_wxyz: int
    velocity: int
    spin_body: int
    si: bool


FORMATS = {
    19: _Columns(position=0, quaternion_wxyz=3, velocity=7, spin_body=10, si=False),  # contact-nets, then 6 controls
    13: _Columns(position=4, quaternion_wxyz=0, velocity=10, spin_body=7, si=True),  # dair_pll
}


@dataclass(frozen=True)
class _Units:
    """What turns a file's numbers into SI."""

    scale_m: float
    dt_s: float


def import_contactnets(
    source: Path, out: Path, scale_m: float | None = None, dt_s: float | None = None, progress: Progress | None = None
) -> ImportReport:
    """Make a session of poses (`/track/pose`, world_from_object) at `out`; tosses keep the numbers of their files.

    `scale_m` (metres per unit of position) and `dt_s` (seconds per step) default to params_processed/experiment.json
    inside or beside `source`. Raises BadInput or WriteFailed; then nothing is left at `out`.
    """
    progress, warnings = progress or Silent(), Warnings()
    files = _toss_files(source, warnings)
    params = _parameters(source)
    raw = {number: _read(path) for number, path in files.items()}
    units = _units(raw, params, scale_m, dt_s, source)
    tosses = {number: _states(table, files[number], units) for number, table in raw.items()}
    checks = check_all(tosses, units.dt_s, warnings)
    twins = duplicates(tosses)
    if twins:
        named = ", ".join("=".join(map(str, group)) for group in twins[:6]) + (", ..." if len(twins) > 6 else "")
        warnings.add(
            f"{len(twins)} groups of tosses are the same recording ({named}): kept; never split a group between "
            "learning and test"
        )
    spans = {number: (0, _time_ns(len(t.position_m) - 1, units.dt_s)) for number, t in tosses.items()}
    offsets = common.clock_offsets_ns(spans)
    start = _start(out, source, params, units, checks, twins)
    with common.new_session(out, start, NO_CALIBRATION) as writer:
        for done, (number, toss) in enumerate(tosses.items()):
            progress.step(done, len(tosses), f"toss {number}")
            group = next((g for g in twins if number in g), ())
            _write_toss(writer, number, toss, units.dt_s, offsets[number], group)
    progress.step(len(tosses), len(tosses))
    return common.report(writer, "contactnets", warnings)


def _toss_files(source: Path, warnings: Warnings) -> dict[int, Path]:
    if source.is_file():
        return {int(source.stem) if source.stem.isdigit() else 0: source}
    if not source.is_dir():
        raise BadInput(f"{source} does not exist; wanted a folder of .pt files, one of them, or their parent")
    folder = source
    if not list(source.glob("*.pt")):
        inside = sorted({p.parent for p in source.glob("*/*.pt")})
        if not inside:
            raise BadInput(f"{source} holds no .pt files; wanted a folder of them, one of them, or their parent")
        published = [p for p in inside if p.name == PUBLISHED]
        if len(inside) > 1 and not published:
            raise BadInput(f"{source} holds several folders of tosses: {[p.name for p in inside]}; give one of them")
        folder = (published or inside)[0]
        if len(inside) > 1:
            others = ", ".join(p.name for p in inside if p != folder)
            warnings.add(f"{folder.name} was imported; {others} beside it was not (give that folder to import it)")
    return {int(p.stem): p for p in common.listed(folder, (".pt",))}


def _parameters(source: Path) -> Mapping[str, Any]:
    """params_processed/experiment.json inside the folder, beside it, or (for one file) beside its folder; else {}."""
    for folder in (source, source.parent, source.parent.parent):
        path = folder / "params_processed" / "experiment.json"
        if path.exists():
            return common.read_json_object(path)
    return {}


def _read(path: Path) -> Float[Array, "t c"]:
    table = read_tensor(path)
    if table.ndim == 3 and table.shape[0] == 1:
        table = table[0]
    if table.ndim == 2 and table.shape[1] == 15:
        raise BadInput(
            f"{path}: 15 columns are an articulated object (dair_pll's elbow); tosslab learns one rigid body"
        )
    if table.ndim != 2 or table.shape[1] not in FORMATS or table.shape[0] < 3:
        raise BadInput(
            f"{path}: a tensor of shape {table.shape}; wanted (1, T, 19) of contact-nets or (T, 13) of dair_pll"
        )
    table = table.astype(np.float64)
    if not np.isfinite(table).all():
        step = int(np.flatnonzero(~np.isfinite(table).all(axis=1))[0])
        raise BadInput(
            f"{path}: step {step} holds NaN or infinity; wanted numbers: move the file away, and import again"
        )
    return table


def _units(
    raw: Mapping[int, Float[Array, "t c"]],
    params: Mapping[str, Any],
    scale_m: float | None,
    dt_s: float | None,
    source: Path,
) -> _Units:
    si = {FORMATS[table.shape[1]].si for table in raw.values()}
    if len(si) > 1:
        raise BadInput(f"{source} mixes files of contact-nets and of dair_pll; import them as two sessions")
    if scale_m is None:
        scale_m = 1.0 if si == {True} else _params_scale_m(params)
    if dt_s is None:
        dt_s = _number(params, "dt")
    if scale_m is None or dt_s is None:
        missing = " and ".join(o for o, v in (("--scale METRES", scale_m), ("--dt SECONDS", dt_s)) if v is None)
        raise BadInput(
            f"{source}: no params_processed/experiment.json inside or beside it, so {missing} must be given "
            "(ContactNets' cube: --scale 0.0524 --dt 0.006756757)"
        )
    if not (1e-4 <= scale_m <= 100 and 1e-5 <= dt_s <= 1):
        raise BadInput(
            f"scale {scale_m:g} m and step {dt_s:g} s; wanted metres per unit of position and seconds per step"
        )
    return _Units(scale_m, dt_s)


def _params_scale_m(params: Mapping[str, Any]) -> float | None:
    """The parameters give gravity in their own unit of length."""
    gravity = _number(params, "g")
    return None if gravity is None else GRAVITY_M_S2 / gravity


def _number(params: Mapping[str, Any], key: str) -> float | None:
    value = params.get(key)
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < float("inf"):
        raise BadInput(f"params_processed/experiment.json: {key} is {value!r}; wanted a positive number")
    return float(value)


def _states(table: Float[Array, "t c"], path: Path, units: _Units) -> States:
    columns = FORMATS[table.shape[1]]

    def part(first: int, count: int) -> Float[Array, "t n"]:
        return table[:, first : first + count]

    quaternions = part(columns.quaternion_wxyz, 4)
    length = np.linalg.norm(quaternions, axis=1)
    if np.abs(length - 1).max() > 1e-2:
        raise BadInput(
            f"{path}: columns {columns.quaternion_wxyz}.. are no unit quaternions (length "
            f"{length.min():.3g}..{length.max():.3g})"
        )
    return States(
        position_m=part(columns.position, 3) * units.scale_m,
        quaternion_wxyz=quaternions / length[:, None],
        velocity_m_s=part(columns.velocity, 3) * units.scale_m,
        spin_rad_s=part(columns.spin_body, 3),
    )


def _start(
    out: Path, source: Path, params: Mapping[str, Any], units: _Units, checks: Checks, twins: Sequence[Sequence[int]]
) -> dict[str, Any]:
    physics = _physics(params)
    start = common.new_start(
        out,
        "contactnets",
        source,
        f"the files have no times: step k at k x {units.dt_s!r} s; every toss starts at clock_offset_ns of its file",
        object={"name": "object", **({"physics": physics} if physics else {})},
    )
    start["import"] |= {
        "scale_m": units.scale_m,
        "dt_s": units.dt_s,
        "checks": vars(checks),
        "duplicates": [list(group) for group in twins],
    }
    return start


def _physics(params: Mapping[str, Any]) -> dict[str, Any]:
    """Mass and inertia (theirs is in kg times their unit of length squared). Friction is to be learned: left out."""
    mass, inertia, scale_m = _number(params, "mass"), params.get("inertia"), _params_scale_m(params)
    if mass is None or inertia is None or scale_m is None:
        return {}
    values = np.array(inertia, dtype=np.float64) * scale_m**2
    if values.shape not in ((), (3,), (3, 3)):
        raise BadInput(f"params_processed/experiment.json: inertia of shape {values.shape}; wanted a number, 3 or 3x3")
    matrix = values if values.ndim == 2 else np.diag(np.broadcast_to(values, 3))
    return {"mass_kg": mass, "inertia_kgm2": matrix.tolist(), "source": "params_processed/experiment.json"}


def _time_ns(step: int, dt_s: float) -> int:
    return round(step * dt_s * 1e9)


def _write_toss(
    writer: SessionWriter, number: int, toss: States, dt_s: float, offset_ns: int, group: Sequence[int]
) -> None:
    info: dict[str, Any] = {"clock_offset_ns": offset_ns, "source": f"{number}.pt"}
    if group:
        info["same_recording_as"] = [n for n in group if n != number]
    with writer.toss(number, info) as t:
        for k in range(len(toss.position_m)):
            pose = Transform.from_quaternion("world", "object", toss.quaternion_wxyz[k], toss.position_m[k])
            t.pose("/track/pose", StampedPose(_time_ns(k, dt_s) + offset_ns, "world", "object", pose.matrix), k)
