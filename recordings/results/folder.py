"""The results folder of `toss-process`: tracks, shapes and masks in stage folders, and which of them a variant is.

```
<results>/<stage>-<key8>/         stage.json and the stage's own files, among them
    toss_XX.track.npz             an ObjectTrack (plain arrays, no pickle)
    shape.ply, shape.json         an ObjectShape: double x y z, uchar red green blue, uchar observed
    contact.json                  a ContactModel
    toss_XX.masks/000000.png      the object's mask in every colour frame, 0 or 255; `toss_XX.masks.json` its confidence
<results>/variants/<name>.<scope>.json   a VariantRecord: which stages hold its final tracks, shapes and masks
```
Reading a result needs nothing but this folder.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray as Array

from recordings.bounded.limits import read_npy
from recordings.errors import BadInput, DamagedFile
from recordings.mcap.codec import decode_mask
from recordings.notices import Notice
from recordings.results.shape_file import read_shape, write_shape
from recordings.results.stage_files import stage_arrays, stage_document, stage_file
from recordings.tracks import ContactModel, ObjectShape, ObjectTrack, RigCalibration, Status
from recordings.whole_file import write_bytes, write_json

RESULTS_FORMAT = 1
Scope = Literal["one", "all"]
CODES: tuple[Status, ...] = ("tracked", "interpolated", "lost")
__all__ = [
    "Masks",
    "Results",
    "Scope",
    "TossRecord",
    "VariantRecord",
    "read_contact",
    "read_masks",
    "read_shape",
    "read_track",
    "write_contact",
    "write_masks",
    "write_shape",
    "write_track",
    "write_variant",
]


def _stem(toss: int) -> str:
    return f"toss_{toss:02d}"


def write_track(folder: Path, track: ObjectTrack) -> Path:
    """Write `toss_XX.track.npz` into a stage's folder. The same track gives the same bytes."""
    import io

    out = io.BytesIO()
    np.savez(
        out,
        format_version=np.array(RESULTS_FORMAT),
        toss=np.array(track.toss),
        camera=np.array(track.camera),
        object_frame=np.array(track.object_frame),
        time_ns=track.time_ns,
        camera_from_object=track.camera_from_object,
        status=np.array([CODES.index(s) for s in track.status], dtype=np.uint8),
        status_names=np.array(CODES),
        covariance=track.covariance,
    )
    path = folder / f"{_stem(track.toss)}.track.npz"
    write_bytes(path, out.getvalue())
    return path


def read_track(folder: Path, toss: int) -> ObjectTrack:
    """Read a toss's track from a stage's folder. Raises BadInput where it has none, DamagedFile where it is broken."""
    path = folder / f"{_stem(toss)}.track.npz"
    if not path.exists():
        raise BadInput(f"{folder} holds no track of toss {toss}; run toss-process again to make it")
    with stage_arrays(path) as stored:
        names = [str(n) for n in stored["status_names"]]
        return ObjectTrack(
            toss=int(stored["toss"]),
            camera=str(stored["camera"]),
            object_frame=str(stored["object_frame"]),
            time_ns=stored["time_ns"].astype(np.int64),
            camera_from_object=stored["camera_from_object"].astype(np.float64),
            status=tuple(CODES[CODES.index(names[s])] for s in stored["status"]),
            covariance=stored["covariance"].astype(np.float64),
        )


def write_masks(folder: Path, toss: int, masks: Sequence[Bool[Array, "h w"]], confidence: Float[Array, " n"]) -> Path:
    """Write the object's mask in every colour frame of a toss, with a confidence 0..1 for each."""
    import cv2

    out = folder / f"{_stem(toss)}.masks"
    out.mkdir(parents=True, exist_ok=True)
    for i, mask in enumerate(masks):
        ok, png = cv2.imencode(".png", mask.astype(np.uint8) * 255)
        if not ok:
            raise BadInput(f"mask {i} of toss {toss} ({mask.shape}) cannot be written as PNG")
        (out / f"{i:06d}.png").write_bytes(png.tobytes())
    write_json(folder / f"{_stem(toss)}.masks.json", {"confidence": [round(float(c), 6) for c in confidence]})
    return out


def write_hand(folder: Path, toss: int, camera_from_hand: Float[Array, "n 4 4"]) -> Path:
    """Write the robot's hand in every colour frame of a toss; NaN where it is not known, or may hold nothing."""
    path = folder / f"{_stem(toss)}.hand.npy"
    np.save(path, camera_from_hand, allow_pickle=False)
    return path


def read_hand(folder: Path, toss: int) -> Float[Array, "n 4 4"] | None:
    """What `write_hand` wrote; None where no robot is known. Raises BadInput where it cannot be read."""
    path = folder / f"{_stem(toss)}.hand.npy"
    try:
        return read_npy(path) if path.exists() else None
    except (OSError, ValueError) as wrong:
        raise BadInput(f"{path} holds no poses of the hand ({wrong}); remove {folder} and run again") from wrong


class Masks(Sequence[Bool[Array, "h w"]]):
    """The masks of one toss, decoded when asked for. `confidence` is 0..1 per frame."""

    def __init__(self, paths: Sequence[Path], confidence: Float[Array, " n"]) -> None:
        self._paths = tuple(paths)
        self.confidence = confidence

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, position: Any) -> Any:
        if isinstance(position, slice):
            return Masks(self._paths[position], self.confidence[position])
        path = self._paths[position]
        return decode_mask(path.read_bytes(), path.name)


def read_masks(folder: Path, toss: int) -> Masks:
    """The masks of one toss in a stage's folder. Raises BadInput where it has none."""
    paths = sorted((folder / f"{_stem(toss)}.masks").glob("*.png"))
    if not paths:
        raise BadInput(f"{folder} holds no masks of toss {toss}; run toss-process again to make them")
    document = stage_document(folder / f"{_stem(toss)}.masks.json")
    return Masks(paths, np.array(document.get("confidence", [np.nan] * len(paths)), dtype=np.float64))


@dataclass(frozen=True)
class RobotMasks:
    """Where the robot is seen in the colour frames of one toss, read when asked for."""

    folder: Path

    @staticmethod
    def of(folder: Path, toss: int) -> RobotMasks | None:
        """Those beside a stage's masks; None where no robot was drawn."""
        path = folder / f"{_stem(toss)}.robot"
        return RobotMasks(path) if any(path.glob("*.png")) else None

    def at(self, position: int, shape: tuple[int, int]) -> Bool[Array, "h w"]:
        """The robot's pixels in one frame; all of them where it was not drawn there, because it may be anywhere."""
        path = self.folder / f"{position:06d}.png"
        return decode_mask(path.read_bytes(), path.name) if path.exists() else np.ones(shape, dtype=bool)


def write_contact(folder: Path, model: ContactModel) -> Path:
    """Write `contact.json` into a stage's folder."""
    path = folder / "contact.json"
    document: dict[str, Any] = {"format_version": RESULTS_FORMAT}
    for name, value in vars(model).items():
        document[name] = value.tolist() if isinstance(value, np.ndarray) else value
    write_json(path, document)
    return path


def read_contact(folder: Path) -> ContactModel:
    """Read a stage's ContactModel. Raises BadInput where it has none."""
    document = dict(stage_document(folder / "contact.json"))
    document.pop("format_version", None)
    with stage_file(folder / "contact.json"):
        arrays = {
            name: np.array(document[name], dtype=np.float64)
            for name in ("support_vertices_m", "inertia_kgm2", "center_of_mass_m", "plane_normal_world")
        }
        pieces = tuple(tuple(int(i) for i in piece) for piece in document["pieces"])
        return ContactModel(**{**document, **arrays, "pieces": pieces})


@dataclass(frozen=True)
class TossRecord:
    """Stage folders of one toss: its track, its shape (in the object frame of that track), its masks."""

    toss: int
    track: str
    shape: str | None = None
    masks: str | None = None


@dataclass(frozen=True, eq=False)
class VariantRecord:
    """What one variant in one scope ended with, as `variants/<name>.<scope>.json` keeps it.

    `shape` is the stage folder of the variant's one shape (scope all). `shared_object_frame`: the tracks of all tosses
    are in one object frame. `session_path` is relative to the results folder. `warnings` (what to know before using the
    result) and `notes` (how it was made) are to be read by a person.
    """

    name: str
    scope: Scope
    label: str
    session_name: str
    object_name: str
    calibration: RigCalibration
    tosses: tuple[TossRecord, ...]
    shape: str | None = None
    contact: str | None = None
    shared_object_frame: bool = False
    session_path: str = ""
    warnings: tuple[Notice, ...] = ()
    notes: tuple[str, ...] = ()
    extra: Mapping[str, Any] = field(default_factory=dict)

    def toss(self, toss: int) -> TossRecord:
        for record in self.tosses:
            if record.toss == toss:
                return record
        raise BadInput(f"{self.name} (scope {self.scope}) holds no toss {toss}; it has {[t.toss for t in self.tosses]}")


def write_variant(results: Path, record: VariantRecord) -> Path:
    """Write `variants/<name>.<scope>.json`, whole or not at all."""
    folder = results / "variants"
    folder.mkdir(parents=True, exist_ok=True)
    document = {k: v for k, v in vars(record).items() if k not in ("calibration", "tosses", "extra")}
    document |= {
        "format_version": RESULTS_FORMAT,
        "warnings": [n.to_json() for n in record.warnings],
        "notes": list(record.notes),
        "tosses": [vars(t) for t in record.tosses],
        "calibration": record.calibration.to_json(),
        "extra": dict(record.extra),
    }
    path = folder / f"{record.name}.{record.scope}.json"
    write_json(path, document)
    return path


def _read_variant(path: Path) -> VariantRecord:
    document = dict(stage_document(path))
    version = document.pop("format_version", None)
    if version != RESULTS_FORMAT:
        raise BadInput(f"{path}: format_version {version!r}; this tosslab reads {RESULTS_FORMAT}")
    try:
        return VariantRecord(
            **{
                **document,
                "calibration": RigCalibration.from_json(document["calibration"]),
                "tosses": tuple(TossRecord(**t) for t in document["tosses"]),
                "warnings": tuple(Notice.from_json(n) for n in document.get("warnings", ())),
                "notes": tuple(document.get("notes", ())),
            }
        )
    except (KeyError, TypeError) as wrong:
        raise DamagedFile(f"{path}: {type(wrong).__name__}: {wrong}; run toss-process again") from wrong


class Results:
    """A results folder, opened. Every method that takes `variant` and `scope` takes None where only one is there."""

    def __init__(self, path: Path, records: Mapping[tuple[str, str], VariantRecord]) -> None:
        self.path = path
        self._records = records

    @staticmethod
    def is_results(path: Path) -> bool:
        """Whether this looks like a results folder (it holds variants/)."""
        return (path / "variants").is_dir()

    @staticmethod
    def open(path: Path) -> Results:
        """Open a results folder, or the results/ of a session. Raises BadInput with what to type next."""
        here = path if Results.is_results(path) or not Results.is_results(path / "results") else path / "results"
        files = sorted((here / "variants").glob("*.json"))
        if not files:
            raise BadInput(f"{path} holds no finished results; wanted a results folder of `toss-process SESSION`")
        found = [_read_variant(f) for f in files]
        return Results(here, {(r.name, r.scope): r for r in found})

    def variants(self) -> tuple[tuple[str, str], ...]:
        """(name, scope) of every variant in this folder."""
        return tuple(self._records)

    def find(self, variant: str | None = None, scope: str | None = None) -> VariantRecord:
        """The one variant that fits. Raises BadInput where none or several do, naming what is there."""
        fitting = [r for (n, s), r in self._records.items() if variant in (None, n) and scope in (None, s)]
        if len(fitting) != 1:
            there = ", ".join(f"--variant {n} --scope {s}" for n, s in self._records)
            asked = f"--variant {variant or '(not given)'} --scope {scope or '(not given)'}"
            raise BadInput(f"{self.path}: {asked} fits {len(fitting)} results; wanted one of: {there}")
        return fitting[0]

    def tracks(self, variant: str | None = None, scope: str | None = None) -> dict[int, ObjectTrack]:
        """The final track of every toss."""
        return {t.toss: read_track(self.path / t.track, t.toss) for t in self.find(variant, scope).tosses}

    def shape(self, variant: str | None = None, scope: str | None = None, toss: int | None = None) -> ObjectShape:
        """The variant's one shape, or with `toss` the shape in the object frame of that toss's track."""
        record = self.find(variant, scope)
        stage = record.shape if toss is None else (record.toss(toss).shape or record.shape)
        if stage is None:
            raise BadInput(
                f"{record.name} (scope {record.scope}) holds no shape"
                + ("; each toss has its own, ask for one toss" if toss is None else f" of toss {toss}")
            )
        return read_shape(self.path / stage)

    def masks(self, variant: str | None = None, scope: str | None = None, toss: int = 0) -> Masks:
        """The masks that the toss was tracked in."""
        record = self.find(variant, scope)
        stage = record.toss(toss).masks
        if stage is None:
            raise BadInput(f"{record.name} (scope {record.scope}) holds no masks of toss {toss}")
        return read_masks(self.path / stage, toss)

    def contact(self, variant: str | None = None, scope: str | None = None) -> ContactModel | None:
        """What was learned of its contact; None for a variant without contact learning."""
        record = self.find(variant, scope)
        return read_contact(self.path / record.contact) if record.contact else None

    def session_path(self, variant: str | None = None, scope: str | None = None) -> Path | None:
        """The recording these results were made from, where it is still there."""
        record = self.find(variant, scope)
        path = (self.path / record.session_path).resolve()
        return path if record.session_path and path.exists() else None

    def stage(self, folder: str) -> Mapping[str, Any]:
        """stage.json of a stage's folder: version, config, inputs, seconds, counts."""
        return stage_document(self.path / folder / "stage.json")
