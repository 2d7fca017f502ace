"""`toss-process --follow`: the session followed to its end, then processed as it would be if it had been asked for."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

from processing.config import Config
from processing.live.follow import Followed, follow
from recordings.console import FELL_SHORT, Outcome
from recordings.errors import TosslabError
from recordings.progress import Silent
from recordings.results.live import LiveWriter, State


def follow_session(
    session: Path, recorder: int | None, config: Config, sample: Path, whole: Callable[[], Outcome]
) -> Outcome:
    """`whole`: the pipeline on the finished session. Lines go to stderr as they come."""
    found = follow(session, config, lambda _: Silent(), _say, recorder, sample=sample)
    if found.why or not (found.looked_at or found.failed):
        text = found.why or f"{session} ended without a toss; there is nothing to process"
        return Outcome(_document(session, found), f"live processing ended: {text}", FELL_SHORT)
    writer = LiveWriter(session)
    writer.say("done", "live: the session is recorded; its results are being made (results/report.html)")
    try:
        outcome = whole()
    except TosslabError as wrong:
        writer.say("fault", f"live: no results were made: {wrong}")
        writer.state(State("stopped", os.getpid()))
        raise
    writer.say("done", f"live: the results are there: toss-view {session / 'results'}, report.html in it")
    writer.state(State("done", os.getpid()))
    return Outcome({**outcome.document, "live": _document(session, found)}, outcome.text, outcome.exit_code)


def _document(session: Path, found: Followed) -> dict[str, object]:
    failed = {str(t): why for t, why in found.failed.items()}
    return {"session": str(session), "looked_at": found.looked_at, "failed": failed, "ended": found.why}


def _say(text: str) -> None:
    sys.stderr.write(text + "\n")
    sys.stderr.flush()
