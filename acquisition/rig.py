"""A rig file: which devices stand in the lab, what a toss is to be, how it is recorded. Unknown keys are refused."""

from __future__ import annotations

import difflib
import tomllib
import types
from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from importlib import resources
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from recordings.bounded.limits import MOST_CONFIG_BYTES, read_bytes
from recordings.errors import BadInput

Kind = Literal["rgbd", "mono", "arm", "gripper"]
MonoEncoding = Literal["jpeg", "lossless"]
RobotName = Literal["panda", "ur5e"]
SHIPPED = "acquisition.rigs"
D455_RATES_HZ = (5, 15, 30, 60, 90)
D455_WIDEST_AT_HZ = {60: 848 * 480, 90: 848 * 480}
ARM_RATES_HZ: Mapping[str, tuple[float, ...]] = {"franka": (1000.0,), "ur": (125.0, 500.0)}
FASTEST_MONO_HZ = 500.0
T = TypeVar("T")


@dataclass(frozen=True)
class DeviceEntry:
    """One device. `name` names its streams and topics; `settings` go to its driver."""

    name: str
    kind: Kind
    driver: str
    serial: str = ""
    """Empty: the only one there is."""
    address: str = ""
    """Of a device on the network."""
    rate_hz: float = 30.0
    latency_ms: float = 0.0
    """Smallest time from an instant to its receipt, where it is known: it is taken off the stamps."""
    settings: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RecordingConfig:
    """How a take is cut and kept."""

    pre_trigger_s: float = 0.5
    after_rest_s: float = 0.4
    longest_toss_s: float = 12.0
    queue_s: float = 1.5
    """What a stream's queue holds before frames are dropped; the lab's cameras send 208 MB a second."""
    reserve_gb: float = 1.0
    """Disk space that is never used."""
    color_jpeg_quality: int = 95
    mono_encoding: MonoEncoding = "jpeg"
    mono_jpeg_quality: int = 95
    between_tosses: bool = False
    """Keep the frames between tosses too: a take then begins where the one before ended."""
    most_lost_share: float = 0.05
    """A take that lost more of a stream than this is rejected."""
    longest_gap_s: float = 0.5
    """A stream that is silent for longer ends the take."""
    redo_at_most: int = 2
    """How often a rejected take is tried again without asking (`--yes`)."""
    countdown_s: float = 3.0


@dataclass(frozen=True)
class TossConfig:
    """The release that is asked of the arm, in the world, and how it varies from toss to toss (uniformly, +-)."""

    position_m: tuple[float, float, float] = (0.0, 0.0, 0.35)
    velocity_m_s: tuple[float, float, float] = (0.0, -0.6, 0.6)
    spin_rad_s: tuple[float, float, float] = (0.0, 0.0, 0.0)
    approach: tuple[float, float, float] = (0.0, 0.0, -1.0)
    """Where the fingers point at the release."""
    roll_deg: float = 0.0
    """Turn of the hand about the approach direction."""
    position_spread_m: float = 0.02
    velocity_spread_m_s: float = 0.1
    spin_spread_rad_s: float = 0.0
    seed: int = 0
    release_delay_s: float = 0.06
    """From the command to the fingers' first movement, before it is measured."""
    release_delay_sigma_s: float = 0.02
    dry_openings: int = 10
    """How often the empty hand is opened when a session begins, to measure the two above; 0: they are believed."""
    open_width_m: float = 0.08
    open_speed_m_s: float = 0.1
    grasp_force_n: float = 40.0
    object_width_m: float = 0.05
    held_mass_kg: float | None = None
    """Of the object, weighed; None: it is asked for when a session begins."""
    held_centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The object's centre of mass from the point between the fingers, in the tool's frame."""
    held_radius_m: float = 0.05
    """No point of the object is farther from the point between the fingers: it is kept clear like the arm."""
    world_from_base: tuple[float, ...] | None = None
    """x y z yaw_deg of the robot's base, for dry runs before it is calibrated; no arm moves by it."""


@dataclass(frozen=True)
class Post:
    """Something that stands in the arm's way: a cylinder with round ends, in the world."""

    name: str
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    radius_m: float


@dataclass(frozen=True)
class Workspace:
    """Where the arm may be, in the world (on the table, z up). No part of it but its foot leaves the box."""

    lower_m: tuple[float, float, float]
    upper_m: tuple[float, float, float]
    posts: tuple[Post, ...]
    """Empty where there are none: that has to be said."""
    cameras: Mapping[str, Any] = field(default_factory=dict)
    """name = [x, y, z] of cameras that the calibration does not place (or that are not in the rig)."""
    camera_radius_m: float = 0.1


@dataclass(frozen=True)
class Rig:
    """A checked rig file."""

    name: str
    devices: tuple[DeviceEntry, ...]
    source: Path
    robot: RobotName | None = None
    calibration: Path | None = None
    calibration_hours: float = 24.0
    """An older calibration is warned of."""
    data_root: Path = Path("sessions")
    """Where sessions go that are given no folder."""
    recording: RecordingConfig = field(default_factory=RecordingConfig)
    toss: TossConfig | None = None
    """None: tossed by hand."""
    workspace: Workspace | None = None
    """A real arm moves nowhere without it."""
    unattended: bool = False
    """A real arm may move with `--yes`: somebody has fenced it off and answers for it."""
    board: Mapping[str, Any] = field(default_factory=dict)
    """The calibration board: kind = "charuco", "chessboard" or "tags" with its sizes; empty: tosslab's own tags."""
    simulation: Mapping[str, Any] = field(default_factory=dict)
    """For the drivers `synthetic` and `replay`."""

    def of_kind(self, kind: Kind) -> tuple[DeviceEntry, ...]:
        return tuple(d for d in self.devices if d.kind == kind)


def find_rig(name: str) -> Path:
    """The path of a rig file, or of a shipped rig by its name."""
    path = Path(name)
    if path.suffix == ".toml":
        if not path.is_file():
            raise BadInput(f"{path} is no file; wanted a rig file, or one of: {', '.join(shipped_rigs())}")
        return path
    if name not in shipped_rigs():
        near = difflib.get_close_matches(name, shipped_rigs(), 1)
        raise BadInput(
            f"no rig '{name}'{_perhaps(near)}; shipped are: {', '.join(shipped_rigs())}. "
            "Copy one of them, or give the path of your own: `toss-record --rig lab.toml`"
        )
    return Path(str(resources.files(SHIPPED) / f"{name}.toml"))


def shipped_rigs() -> list[str]:
    return sorted(p.name[:-5] for p in resources.files(SHIPPED).iterdir() if p.name.endswith(".toml"))


def read_rig(path: Path) -> Rig:
    """Read and check a rig file. Raises BadInput naming the key, the device or the rate."""
    try:
        table = tomllib.loads(read_bytes(path, MOST_CONFIG_BYTES, "a rig file").decode())
    except RecursionError as wrong:
        raise BadInput(f"{path}: cannot be read as a rig file (its lists are nested without end)") from wrong
    except (OSError, ValueError) as wrong:
        raise BadInput(f"{path}: cannot be read as a rig file ({wrong})") from wrong
    named = table.pop("devices", {})
    if not isinstance(named, dict) or not all(isinstance(d, dict) for d in named.values()):
        raise BadInput(f"{path}: wanted [devices.NAME] tables, found {named!r}")
    devices = tuple(
        from_table(DeviceEntry, {"name": name, **entry}, f"{path}: [devices.{name}]") for name, entry in named.items()
    )
    rig = from_table(Rig, {**table, "devices": devices, "source": path}, str(path))
    check_rig(rig)
    return rig


def check_rig(rig: Rig) -> None:
    """Raises BadInput for devices that cannot stand together, and for rates that a device cannot do."""
    _check_devices(rig)
    for device in rig.devices:
        _check_rate(device, rig.source)
    r = rig.recording
    if not (0 <= r.pre_trigger_s <= 5 and r.after_rest_s >= 0 and 0 < r.longest_toss_s <= 600 and r.queue_s > 0):
        raise BadInput(f"{rig.source}: [recording] has a time that makes no sense: {r}")
    if not (1 <= r.color_jpeg_quality <= 100 and 1 <= r.mono_jpeg_quality <= 100):
        raise BadInput(f"{rig.source}: [recording] JPEG qualities go from 1 to 100")
    if rig.toss is not None and rig.robot is None:
        raise BadInput(f'{rig.source}: a [toss] needs an arm: add robot = "panda" or "ur5e"')


def _check_devices(rig: Rig) -> None:
    if not rig.devices:
        raise BadInput(f"{rig.source}: no [devices.NAME]; wanted at least one camera")
    seen: dict[tuple[str, str], str] = {}
    for device in rig.devices:
        if not device.name.replace("_", "").isalnum() or device.name.endswith("_depth"):
            raise BadInput(
                f"{rig.source}: device name '{device.name}'; wanted letters, digits and _ (not ending _depth)"
            )
        for what, value in (("serial", device.serial), ("address", device.address)):
            if device.kind == "gripper" or not value:
                continue  # a hand shares the address of its arm
            other = seen.setdefault((what, value), device.name)
            if other != device.name:
                raise BadInput(
                    f"{rig.source}: '{other}' and '{device.name}' have the same {what} {value}; "
                    "every device has its own: see `toss-record --doctor OUT`"
                )
    for kind in ("arm", "gripper"):
        if len(rig.of_kind(kind)) > 1:
            raise BadInput(f"{rig.source}: {len(rig.of_kind(kind))} devices of kind {kind}; a session has one at most")


def _check_rate(device: DeviceEntry, source: Path) -> None:
    rate = device.rate_hz
    where = f"{source}: [devices.{device.name}] rate_hz = {rate:g}"
    if not 0 < rate <= 10_000:
        raise BadInput(f"{where}; wanted a positive number")
    if device.driver == "d455":
        if rate not in D455_RATES_HZ:
            raise BadInput(f"{where}: a D455 does {', '.join(map(str, D455_RATES_HZ))}")
        for prefix in ("", "color_"):
            width, height = (int(device.settings.get(prefix + side, 0)) for side in ("width", "height"))
            if width * height > D455_WIDEST_AT_HZ.get(int(rate), 1280 * 800):
                raise BadInput(f"{where}: a D455 does {width}x{height} only up to 30 frames per second")
    elif device.driver in ARM_RATES_HZ and device.kind == "arm":
        if rate not in ARM_RATES_HZ[device.driver]:
            raise BadInput(f"{where}: {device.driver} does {', '.join(f'{r:g}' for r in ARM_RATES_HZ[device.driver])}")
    elif device.kind == "mono" and rate > FASTEST_MONO_HZ:
        raise BadInput(f"{where}; no camera that the driver knows is faster than {FASTEST_MONO_HZ:g}")


def from_table(kind: type[T], table: Mapping[str, Any], where: str) -> T:
    """A dataclass from a TOML table: unknown keys are refused by name with the nearest known one, types are checked."""
    known = {f.name: f for f in fields(kind)}  # type: ignore[arg-type]
    for key in table:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.5)
            raise BadInput(f"{where}: unknown key '{key}'{_perhaps(near)}; it knows {', '.join(known)}")
    missing = [n for n, f in known.items() if n not in table and f.default is MISSING and f.default_factory is MISSING]
    if missing:
        raise BadInput(f"{where}: {', '.join(missing)} missing")
    hints = get_type_hints(kind)
    return kind(**{key: _value(hints[key], value, f"{where}: {key}") for key, value in table.items()})


def _value(hint: Any, value: Any, where: str) -> Any:
    """`value` as `hint` wants it; whole numbers serve as floats, lists as tuples."""
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        inner = [h for h in get_args(hint) if h is not type(None)]
        return None if value is None else _value(inner[0], value, where)
    if origin is Literal:
        if value not in get_args(hint):
            near = difflib.get_close_matches(str(value), [str(a) for a in get_args(hint)], 1)
            raise BadInput(f"{where} = {value!r}{_perhaps(near)}; wanted one of {', '.join(map(str, get_args(hint)))}")
        return value
    if origin is tuple:
        return _tuple(hint, value, where)
    if is_dataclass(hint) and isinstance(value, dict):
        return from_table(hint, value, where)  # type: ignore[arg-type]
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if hint is Path and isinstance(value, str):
        return Path(value)
    wanted = dict if origin is not None and issubclass(origin, Mapping) else hint
    if not isinstance(value, wanted) or (isinstance(value, bool) and wanted is not bool):
        raise BadInput(f"{where} = {value!r}; wanted {getattr(wanted, '__name__', wanted)}")
    return value


def _tuple(hint: Any, value: Any, where: str) -> tuple[Any, ...]:
    args = get_args(hint)
    if not isinstance(value, list | tuple):
        raise BadInput(f"{where} = {value!r}; wanted a list")
    if args[-1] is Ellipsis:
        return tuple(_value(args[0], v, where) for v in value)
    if len(value) != len(args):
        raise BadInput(f"{where} = {value!r}; wanted {len(args)} values")
    return tuple(_value(a, v, where) for a, v in zip(args, value))


def _perhaps(near: list[str]) -> str:
    return f" (do you mean '{near[0]}'?)" if near else ""
