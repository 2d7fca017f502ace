"""How the cycle came to a variant's result: its passes, read backwards from where the variant ended.

A variant's record names the last stages only. Each stage.json names the keys of what it was made from, and a key's
first letters end the folder's name: so the pass before is found, down to the first one. What is missing in a folder (an
older run, stages that were removed) is left out.

```
<reproject>/toss_XX.icp.npz   verdict, fitness, rmse_m, held (n): how the shape was laid onto the raw depth
<judge>/residuals.npz         rows (toss, position, depth_m, mask, color): how well a pass explains the raw images
<contact>/rollouts.npz        toss; toss_XX.world_from_object (t, 4, 4), toss_XX.time_s (t) since its first frame;
                              beside it in the stage `rollout`, on the last poses
```
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64
from numpy import ndarray as Array

from recordings.errors import BadInput
from recordings.results.folder import Results, VariantRecord, read_shape, read_track
from recordings.results.stage_files import read_arrays, stage_file
from recordings.tracks import ObjectShape, ObjectTrack

ALIGNED = "aligned"
FILLED = "every-frame-"
FIRST, SECOND, JOINT = "first pass", "pass {}", "joint objective"


@dataclass(frozen=True, eq=False)
class Laid:
    """How the shape was laid onto the raw depth of every frame before it was drawn for the next pass (D to D'').

    `verdict`: `aligned`, or why ICP's correction was rejected; `rmse_m` of the matched points, NaN where there are
    none; `fitness`: their share; `held`: directions of six that the frame's depth does not say.
    """

    verdict: tuple[str, ...]
    fitness: Float[Array, " n"]
    rmse_m: Float[Array, " n"]
    held: Int64[Array, " n"]

    @property
    def rejected(self) -> Bool[Array, " n"]:
        return np.array([v != ALIGNED for v in self.verdict], dtype=bool)


@dataclass(frozen=True, eq=False)
class Judged:
    """Residuals on the raw images at the frames (`position`) that were looked at."""

    position: Int64[Array, " k"]
    depth_m: Float[Array, " k"]
    mask: Float[Array, " k"]
    color: Float[Array, " k"]


@dataclass(frozen=True, eq=False)
class Step:
    """One pass over one toss. `learned`: the shape as contact corrected it, with `rollout`; both None where nothing was
    learned. `drawn`: the poses at which the shape was drawn for the next pass, `laid` how ICP found them."""

    label: str
    track: ObjectTrack
    shape: ObjectShape | None
    learned: ObjectShape | None = None
    judged: Judged | None = None
    judged_learned: Judged | None = None
    drawn: ObjectTrack | None = None
    laid: Laid | None = None


@dataclass(frozen=True, eq=False)
class Rollout:
    """The learned model let go at the release: `world_from_object` at times on the session clock, and its body."""

    time_ns: Int64[Array, " t"]
    world_from_object: Float[Array, "t 4 4"]
    shape: ObjectShape | None


@dataclass(frozen=True, eq=False)
class TossCycle:
    """The passes of one toss, the first one first, and the learned model's rollout beside it."""

    steps: tuple[Step, ...]
    rollout: Rollout | None

    @property
    def has_passes(self) -> bool:
        """More than the result itself."""
        first = self.steps[0]
        return len(self.steps) > 1 or bool(first.learned or first.judged or self.rollout)


def read_cycle(results: Results, record: VariantRecord) -> dict[int, TossCycle]:
    """Of each toss of a variant what is known of its passes. Raises DamagedFile for files that cannot be read."""
    reader = _Reader(results, record)
    found = {t.toss: reader.toss(t.toss, t.track, t.shape or record.shape) for t in record.tosses}
    return {t: cycle for t, cycle in found.items() if cycle.has_passes}


class _Reader:
    """Follows keys through a results folder; every file is read once."""

    def __init__(self, results: Results, record: VariantRecord) -> None:
        self._results, self._record = results, record
        self._folders = {p.name[-8:]: p.name for p in results.path.iterdir() if (p / "stage.json").exists()}
        self._documents: dict[str, Mapping[str, Any]] = {}
        self._shapes: dict[str, ObjectShape] = {}
        self._arrays: dict[Path, Mapping[str, Any]] = {}
        self._judges = [name for name in self._folders.values() if name.startswith("judge-")]

    def toss(self, toss: int, track: str, shape: str | None) -> TossCycle:
        chain = self._chain(toss, track, shape)
        contact = self._contact_of(toss, chain)
        steps = [self._step(toss, i, chain, contact) for i in range(len(chain))]
        return TossCycle(tuple(steps), self._rollout(toss, contact[-1], shape, steps[-1].track))

    def _chain(self, toss: int, track: str, shape: str | None) -> list[_Names]:
        """Stage names of the passes, the first one first."""
        found = [_Names(track, shape)]
        while (before := self._before(toss, found[0].track)) is not None:
            found.insert(0, before)
        return found

    def _before(self, toss: int, track: str) -> _Names | None:
        """The pass that a track was refined from: through the frames drawn for it, or where `joint` began."""
        own = self._unadjusted(toss, self._before_still(toss, track))
        inputs = self._inputs(own)
        drawn = own if own.startswith("reproject-") else self._folder(inputs.get("drawn"))
        source = self._inputs(drawn) if drawn is not None else inputs if own.startswith("joint-") else {}
        earlier = self._folder(source.get(f"track_{toss:02d}"))
        return None if earlier is None else _Names(earlier, self._folder(source.get("shape")), drawn)

    def _unadjusted(self, toss: int, track: str) -> str:
        """The stage whose poses of a toss a stage has adjusted; else itself."""
        before = self._folder(self._inputs(track).get(f"track_{toss:02d}"))
        return before if before is not None and track.startswith("adjust-") else track

    def _before_still(self, toss: int, track: str) -> str:
        """The stage whose poses were filled up where the object stood still; else itself."""
        before = self._folder(self._inputs(track).get(f"track_{toss:02d}"))
        return before if before is not None and track.startswith(FILLED) else track

    def _contact_of(self, toss: int, chain: list[_Names]) -> list[str | None]:
        """The contact stage of every pass: the one whose shape was drawn, or the one that the record names."""
        named = self._record.extra.get("contact_of_toss", {}).get(str(toss)) or self._record.contact
        found: list[str | None] = []
        for names in chain:
            drawn = names.shape is not None and names.shape.startswith("contact-")
            own = names.shape if drawn else None
            if own is None and named is not None and self._learned_on(named, toss, names.track):
                own = named
            found.append(own)
        return [*found, named if named is not None and named in self._folders.values() else None]

    def _learned_on(self, contact: str, toss: int, track: str) -> bool:
        key = self._inputs(contact).get(f"track_{toss:02d}")
        whole = self._document(contact).get("counts", {}).get("kept_out") is None
        return whole and self._folder(key) == self._before_still(toss, track)

    def _step(self, toss: int, index: int, chain: list[_Names], contact: list[str | None]) -> Step:
        names, learned = chain[index], contact[index]
        vision = self._folder(self._inputs(learned).get("shape")) if names.shape == learned else names.shape
        label = FIRST if index == 0 else JOINT if names.track.startswith("joint-") else SECOND.format(index + 1)
        drawn = None if names.drawn is None else self._track(names.drawn, toss)
        return Step(
            label,
            read_track(self._results.path / names.track, toss),
            self._shape(vision),
            self._shape(learned),
            self._judged(toss, names.track, vision),
            self._judged(toss, names.track, learned),
            drawn,
            None if names.drawn is None else self._laid(names.drawn, toss),
        )

    def _laid(self, stage: str, toss: int) -> Laid | None:
        path = self._results.path / stage / f"toss_{toss:02d}.icp.npz"
        values = self._read(path)
        if not values:
            return None
        with stage_file(path):
            verdict = tuple(str(v) for v in values["verdict"])
            return Laid(verdict, values["fitness"], values["rmse_m"], values["held"].astype(np.int64))

    def _judged(self, toss: int, track: str, shape: str | None) -> Judged | None:
        """Residuals of a shape at a track's poses, where they were taken."""
        track = self._before_still(toss, track)
        for name in self._judges if shape is not None else ():
            inputs = self._inputs(name)
            wanted = (inputs.get(f"track_{toss:02d}"), inputs.get(f"shape_{toss:02d}"))
            if tuple(self._folder(key) for key in wanted) != (track, shape):
                continue
            path = self._results.path / name / "residuals.npz"
            with stage_file(path):
                rows = self._read(path)["rows"]
                mine = rows[rows[:, 0] == toss]
                return Judged(mine[:, 1].astype(np.int64), mine[:, 2], mine[:, 3], mine[:, 4])
        return None

    def _rollout(self, toss: int, contact: str | None, shape: str | None, track: ObjectTrack) -> Rollout | None:
        """The rollout on the last poses, where the last toss was not learned from; else what contact learning kept."""
        for stage, body in ((self._record.extra.get("rollout"), shape), (contact, contact)):
            path = self._results.path / str(stage) / "rollouts.npz"
            values, name = self._read(path), f"toss_{toss:02d}"
            if stage is None or f"{name}.time_s" not in values or len(track.time_ns) == 0:
                continue
            with stage_file(path):
                time_ns = int(track.time_ns[0]) + np.round(1e9 * values[f"{name}.time_s"]).astype(np.int64)
                return Rollout(time_ns, values[f"{name}.world_from_object"], self._shape(body))
        return None

    def _track(self, stage: str, toss: int) -> ObjectTrack | None:
        try:
            return read_track(self._results.path / stage, toss)
        except BadInput:
            return None

    def _shape(self, stage: str | None) -> ObjectShape | None:
        if stage is None:
            return None
        if stage not in self._shapes:
            try:
                self._shapes[stage] = read_shape(self._results.path / stage)
            except BadInput:
                return None
        return self._shapes[stage]

    def _folder(self, key: object) -> str | None:
        """The stage folder with this whole key."""
        name = self._folders.get(str(key)[:8])
        return name if name is not None and self._document(name).get("key") == key else None

    def _inputs(self, stage: str | None) -> Mapping[str, Any]:
        return {} if stage is None else self._document(stage).get("inputs", {})

    def _document(self, stage: str) -> Mapping[str, Any]:
        if stage not in self._documents:
            known = stage in self._folders.values()
            self._documents[stage] = self._results.stage(stage) if known else {}
        return self._documents[stage]

    def _read(self, path: Path) -> Mapping[str, Any]:
        """Every array of a file; nothing where there is none."""
        if path not in self._arrays:
            self._arrays[path] = read_arrays(path)
        return self._arrays[path]


@dataclass(frozen=True)
class _Names:
    """Stage folders of one pass: its track, its shape, and the frames that were drawn from them for the next pass."""

    track: str
    shape: str | None
    drawn: str | None = None
