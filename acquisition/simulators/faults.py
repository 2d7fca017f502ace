"""The fault interface that all simulators share: what goes wrong, when, and for how long.

    arm = FciServer("127.0.0.1")
    arm.inject("reflex", at_s=0.4)              # once, 0.4 s from now
    arm.inject("freeze", at_s=1.0, for_s=0.5)   # a state that lasts
    arm.inject("lost_packets", share=0.05)      # now, until cleared
    arm.clear("lost_packets")

Each simulator lists its kinds in `FAULTS`, with a line on what each does; an unknown kind is refused by name.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeVar

from recordings.errors import BadInput

Opened = TypeVar("Opened", bound="Faulty")


@dataclass(frozen=True)
class Fault:
    """One fault: active from `from_ns` (time.monotonic_ns) until `until_ns` or, when that is None, until cleared."""

    kind: str
    from_ns: int
    until_ns: int | None
    detail: Mapping[str, float | str] = field(default_factory=dict)

    def number(self, name: str, default: float) -> float:
        return float(self.detail.get(name, default))

    def active(self, now_ns: int) -> bool:
        return self.from_ns <= now_ns and (self.until_ns is None or now_ns < self.until_ns)


class Faults:
    """The faults of one simulator. Thread-safe; asking costs next to nothing while none is planned."""

    def __init__(self, kinds: Mapping[str, str]) -> None:
        self.kinds = kinds
        self._planned: list[Fault] = []
        self._lock = threading.Lock()

    def inject(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **detail: float | str) -> None:
        """Plan a fault `at_s` seconds from now. Raises BadInput for a kind this simulator does not know."""
        if kind not in self.kinds:
            raise BadInput(f"no fault '{kind}' here; this simulator knows {', '.join(sorted(self.kinds))}")
        start = time.monotonic_ns() + round(at_s * 1e9)
        until = None if for_s is None else start + round(for_s * 1e9)
        with self._lock:
            self._planned.append(Fault(kind, start, until, detail))

    def clear(self, kind: str) -> None:
        """Forget every fault of this kind, also those still to come."""
        with self._lock:
            self._planned = [fault for fault in self._planned if fault.kind != kind]

    def active(self, kind: str, at_ns: int | None = None) -> Fault | None:
        """The fault of this kind that holds now, or held at a time (time.monotonic_ns), if any."""
        if not self._planned:
            return None
        when_ns = time.monotonic_ns() if at_ns is None else at_ns
        with self._lock:
            return next((fault for fault in self._planned if fault.kind == kind and fault.active(when_ns)), None)

    def take(self, kind: str) -> Fault | None:
        """As `active`, and forgotten: for what happens once."""
        fault = self.active(kind)
        if fault is not None:
            with self._lock:
                if fault not in self._planned:
                    return None
                self._planned.remove(fault)
        return fault


class Faulty:
    """A simulator into which faults are injected."""

    _faults: Faults

    def __enter__(self: Opened) -> Opened:
        return self

    def __exit__(self, *exc: object) -> None:
        self.close()

    def close(self) -> None:
        """End it."""
        raise NotImplementedError

    def inject(self, kind: str, at_s: float = 0.0, for_s: float | None = None, **detail: float | str) -> None:
        """Plan a fault `at_s` seconds from now, for `for_s` seconds or until cleared."""
        self._faults.inject(kind, at_s, for_s, **detail)

    def clear(self, kind: str) -> None:
        """Forget every fault of this kind."""
        self._faults.clear(kind)
