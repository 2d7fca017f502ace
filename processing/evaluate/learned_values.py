"""What contact learning says of itself, for the table: friction, restitution and rollouts with their intervals, all of
it without truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.special import stdtrit

from processing.evaluate.score import Value, rollout_values
from recordings.results.folder import Results, VariantRecord, read_contact
from recordings.results.stage_files import stage_document


def learned_values(results: Results, record: VariantRecord) -> dict[str, Value]:
    """`friction`, `restitution` (where frames are slow enough that it is learned) and `rollout_track_position` and
    `rollout_track_rotation`: the rollouts of all tosses against the estimated tracks. Empty for a row without contact.
    """
    return {**_numbers(results, record), **_rollouts(results, record)}


def _numbers(results: Results, record: VariantRecord) -> dict[str, Value]:
    """In scope one each toss has learned its own: their mean, with its interval over tosses."""
    stages = {int(t): str(s) for t, s in record.extra.get("contact_of_toss", {}).items()}
    if record.contact is not None:
        stages = dict.fromkeys((t.toss for t in record.tosses), record.contact)
    learned = {t: _learned(results.path / stage) for t, stage in stages.items()}
    found = {}
    for name in ("friction", "restitution"):
        known = [x[name] for x in learned.values() if name in x]
        if known and record.scope == "all":
            value, low, high = known[0]
            found[name] = Value(value, "", len(known), "nothing", low, high)
        elif known:
            found[name] = _mean(known)
    return found


def _learned(stage: Path) -> dict[str, tuple[float, float, float]]:
    """Value, lower and upper bound by name, of one stage `contact`."""
    model = read_contact(stage)
    found = {"friction": (model.friction, model.friction_low, model.friction_high)}
    document = stage_document(stage / "result.json") if (stage / "result.json").exists() else {}
    rebound = document.get("restitution")
    if isinstance(rebound, dict):
        found["restitution"] = (rebound["value"], rebound["low"], rebound["high"])
    return found


def _mean(known: list[tuple[float, float, float]]) -> Value:
    """The mean over tosses with Student's interval; of a single toss its own interval."""
    values, n = np.array([x[0] for x in known]), len(known)
    if n == 1:
        return Value(known[0][0], "", 1, "nothing", known[0][1], known[0][2])
    mean, half = float(values.mean()), float(stdtrit(n - 1, 0.975) * values.std(ddof=1) / n**0.5)
    return Value(mean, "", n, "nothing, mean over tosses", max(mean - half, 0.0), mean + half)


def _rollouts(results: Results, record: VariantRecord) -> dict[str, Value]:
    stage = record.extra.get("rollout")
    if stage is None:
        return {}
    document = stage_document(results.path / stage / "rollout.json")
    return rollout_values(document["against_track"], "rollout_track", "the estimated track, met at the release")
