"""How a stage that was computed in another process ended: nothing to tell, or what it raised, as plain values.

JSON rather than a pickled exception: the same words travel through a pipe and through a marker on a shared disk, and
reading them executes nothing.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any

from recordings import errors
from recordings.errors import TosslabError

Outcome = dict[str, Any]
"""Empty, or `kind` (the exception's name), `message`, `arguments` (an OSError's) and `trace`."""


class Fault(Exception):
    """What is no error of the user's, as another process raised it; its lines are in the message."""


class Lost(TosslabError):
    """A process that ended without telling how its stage ended."""


def outcome_of(call: Callable[[], object]) -> Outcome:
    """Calls it, and says how that ended."""
    try:
        call()
    except Exception as wrong:
        outcome: Outcome = {"kind": type(wrong).__name__, "message": str(wrong), "trace": traceback.format_exc()}
        if isinstance(wrong, OSError):
            outcome |= {"kind": "OSError", "arguments": [wrong.errno, wrong.strerror, wrong.filename]}
        if isinstance(wrong, ImportError):
            outcome |= {"kind": "ImportError"}
        return outcome
    return {}


def raise_outcome(outcome: Outcome) -> None:
    """The same error again, in this process."""
    if not outcome:
        return
    kind, message = str(outcome["kind"]), str(outcome["message"])
    known = getattr(errors, kind, None)
    if isinstance(known, type) and issubclass(known, TosslabError):
        raise known(message)
    if kind == "OSError":
        number, text, file = outcome["arguments"]
        raise OSError(number, text, file)
    if kind == "ImportError":
        raise ImportError(message)
    raise Fault(f"{kind}: {message}\n{outcome.get('trace', '')}".rstrip())
