"""Whether a take is worth keeping: from its counts, its troubles and what was seen of the toss."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from acquisition.detect import TossEvents
from acquisition.rig import RecordingConfig
from acquisition.streaming.sequence_check import Trouble
from acquisition.streaming.streams import Tally
from acquisition.verdict import Verdict

FATAL_KINDS = {
    "lost": "a device was lost",
    "silent": "a stream fell silent",
    "frozen": "a camera froze",
    "clock step": "a device's clock was set",
    "invalid": "images of another size",
    "gripper": "the gripper did not do what it was told",
    "motion": "the arm did not finish its motion",
    "reflex": "the arm went into reflex",
    "user_stopped": "emergency stop",
    "error": "the arm reports an error",
    "disk": "the disk",
    "fault": "a driver failed",
}


def judge(
    counts: Mapping[str, Tally],
    troubles: Sequence[Trouble],
    events: TossEvents,
    config: RecordingConfig,
    expects_toss: bool = True,
    write_failure: str = "",
    waited_for: str = "",
) -> Verdict:
    """The recorder's own verdict; a person may overrule it."""
    reasons, warnings = [], []
    if write_failure:
        reasons.append(write_failure)
    for trouble in troubles:
        if trouble.kind in FATAL_KINDS and trouble.level == "error":
            reasons.append(f"{FATAL_KINDS[trouble.kind]} ({trouble.device}: {trouble.text})")
    for topic, tally in counts.items():
        again = tally.dropped.get("duplicate", 0)
        lost = tally.dropped_total - again + tally.missed
        whole = tally.received - again + tally.missed
        if tally.written == 0:
            reasons.append(f"{topic}: nothing was written")
        elif lost > config.most_lost_share * whole:
            reasons.append(f"{topic}: {lost} of {whole} lost {_causes(tally)}")
        elif lost or again:
            warnings.append(f"{topic}: {lost} of {whole} lost {_causes(tally)}")
    if waited_for:
        warnings.append(f"cut after {config.longest_toss_s:g} s ([recording] longest_toss_s): {waited_for}")
    if expects_toss:
        missing = [
            name
            for name, moment in (
                ("release", events.release),
                ("first impact", events.first_impact),
                ("rest", events.rest),
            )
            if moment is None
        ]
        if missing:
            warnings.append(f"not seen: {', '.join(missing)}")
        if events.release is None:
            reasons.append("no release was seen")
    return Verdict("reject" if reasons else "accept", tuple(dict.fromkeys(reasons)), tuple(dict.fromkeys(warnings)))


def _causes(tally: Tally) -> str:
    parts = [f"{n} {cause}" for cause, n in tally.dropped.items()]
    parts += [f"{tally.missed} missing from the device"] if tally.missed else []
    return f"({', '.join(parts)})"
