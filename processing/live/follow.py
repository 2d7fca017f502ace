"""`toss-process --follow SESSION`: every toss is looked at when its file is whole; the recorder is never waited for.

What is found goes into SESSION/results/live (see recordings/results/live.py) and to the console. One process follows a
session at a time; it comes last on the machine and its memory is bounded.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from processing.config import Config
from processing.live import bounds
from processing.live.config import LiveConfig
from processing.live.friction import LawSoFar
from processing.live.look import Looker
from processing.live.side_work import SideWork
from processing.live.together import Joined, Together
from processing.live.watch import FileId, ended, finished, finished_tosses
from processing.run import CAMERA
from processing.segment.background.static_scene import StaticScene
from processing.segment.robot.of_session import Rig
from recordings.errors import BadInput, TosslabError
from recordings.progress import Progress
from recordings.results.folder import write_shape
from recordings.results.live import Kind, LiveWriter, State, live_folder
from recordings.session import Session
from recordings.tracks import RigCalibration
from recordings.whole_file import write_json

NO_TABLE = (
    "the table is not calibrated: neither flight nor rest nor friction is judged, only masks, tracks and the shape; "
    "`toss-calibrate table SESSION` for the next session"
)
SCRATCH = ".scratch"


class TossGone(Exception):
    """The toss that is worked on was taken away, or recorded anew."""


@dataclass
class Followed:
    """What became of a followed session. `why`: why it ended before its recorder did; empty: the recorder ended it."""

    looked_at: list[int] = field(default_factory=list)
    failed: dict[int, str] = field(default_factory=dict)
    why: str = ""


def follow(
    session: Path,
    config: Config,
    progress: Callable[[str], Progress],
    console: Callable[[str], None],
    recorder: int | None = None,
    live: LiveConfig | None = None,
    sample: Path | None = None,
) -> Followed:
    """Look at every toss until the session ends. `console`: prints a line; `recorder`: the process that
    records, where it is known: when it is gone, nothing more comes; `sample`: a session to load the kernels with while
    there is nothing to do yet.

    Raises BadInput where the folder is no session, has no intrinsics of the camera, or is followed already.
    """
    calibration = _checked(session)
    with followed_alone(session), _scratch(session) as scratch:
        live = live or LiveConfig()
        together = Together(calibration, CAMERA, live)
        looker = Looker(session, scratch, config, live, progress)
        run = _Follower(session, looker, together, LiveWriter(session), live, console, recorder)
        bounds.come_last()
        bounds.bound_memory(live.memory_gb)
        try:
            if sample is not None:
                warm_up(sample, session, replace(looker, session=sample, scratch=scratch / "warm"), live)
            return run.until_end()
        finally:
            bounds.unbound_memory()


def _checked(session: Path) -> RigCalibration:
    with Session.open(session) as opened:
        if not session.is_dir():
            raise BadInput(f"--follow {session}: wanted the folder of a session that is recorded, not one file of it")
        if CAMERA not in opened.calibration.cameras:
            raise BadInput(f"--follow {session}: its calibration has no intrinsics of {CAMERA}; vision needs them")
        return opened.calibration


@contextlib.contextmanager
def followed_alone(session: Path) -> Iterator[None]:
    """One follower per session; the system lets go of the lock however its holder ends. Raises BadInput."""
    folder = live_folder(session)
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / ".follow.lock", "a+") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as held:
            lock.seek(0)
            raise BadInput(
                f"{session} is followed already, by process {lock.read().strip() or 'of another user'}; look at what "
                f"it finds with `toss-view --live {session}`, or end it first"
            ) from held
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        yield


@contextlib.contextmanager
def _scratch(session: Path) -> Iterator[Path]:
    """What is kept for this process alone."""
    with tempfile.TemporaryDirectory(prefix=SCRATCH, dir=live_folder(session)) as folder:
        yield Path(folder)


def warm_up(sample: Path, session: Path, looker: Looker, live: LiveConfig) -> None:
    """Load every kernel by looking at tosses of a sample, until the first toss of the session is there."""
    with Session.open(sample) as opened:
        together, tosses = Together(opened.calibration, CAMERA, live), opened.tosses
    files = finished_tosses(sample)
    with contextlib.suppress(TossGone):
        for toss in tosses[:2]:
            together.add(looker.look(toss, files[toss], lambda _: _unless_waited_for(session)))


def _unless_waited_for(session: Path) -> None:
    if finished_tosses(session):
        raise TossGone


@dataclass
class _Follower:
    """The loop."""

    session: Path
    looker: Looker
    together: Together
    writer: LiveWriter
    live: LiveConfig
    console: Callable[[str], None]
    recorder: int | None
    done: dict[int, FileId] = field(default_factory=dict)
    result: Followed = field(default_factory=Followed)
    lag_reported_s: float = 0.0
    started_s: float = field(default_factory=time.time)
    side: SideWork[LawSoFar] = field(default_factory=SideWork)

    def until_end(self) -> Followed:
        self._state("waiting")
        self._say("ready", "live: ready; each toss is looked at when it is recorded")
        if self.together.world_from_camera is None:
            self._say("fault", NO_TABLE)
        try:
            while not self.result.why:
                ends = ended(self.session)  # asked first: a toss that was finished before it is still seen
                if not self._turn() and ends and not self.side.running:
                    break
        except MemoryError:
            self.result.why = (
                f"more than the {self.live.memory_gb:g} GB that live processing may take would be needed; it ends, and "
                f"recording goes on; afterwards: toss-process {self.session}"
            )
        finally:
            self.side.stop()
            self._state("stopped" if self.result.why else "finishing")
        if self.result.why:
            self._say("fault", f"live: {self.result.why}")
        return self.result

    def _turn(self) -> bool:
        """One thing that is to do; False where nothing was."""
        files = finished_tosses(self.session)
        for toss in [t for t in self.done if files.get(t) != self.done[t]]:
            self._forget(toss, "was taken away" if toss not in files else "was recorded anew")
        waiting = [t for t in files if t not in self.done]
        if waiting:
            self.side.stop()  # a law of fewer tosses is of no use any more
            self._report_lag(files, waiting)
            self._look_at(waiting[0], files[waiting[0]], len(waiting) - 1)
            return True
        self.lag_reported_s = 0.0
        if self._idle():
            return True
        if self.recorder is not None and not alive(self.recorder) and not ended(self.session):
            self.result.why = (
                "the recorder ended without closing the session; go on with "
                f"`toss-record --resume --live {self.session}`"
            )
        self._state("waiting")
        time.sleep(self.live.poll_s)
        return False

    def _look_at(self, toss: int, file: FileId, waiting: int) -> None:
        path = self.session / f"toss_{toss:02d}.mcap"

        def step(_: str) -> None:
            if finished(path) != file:
                raise TossGone

        self._state("working", toss, waiting, self._waited_s(file))
        self.done[toss] = file
        try:
            joined = self.together.add(self.looker.look(toss, file, step))
            step("joined")
        except TossGone:
            self._forget(toss, "was taken away while it was looked at")
        except (TosslabError, OSError) as wrong:
            if finished(path) != file:
                self._forget(toss, "was taken away while it was looked at")
                return
            self.result.failed[toss] = str(wrong)
            self._say("fault", f"toss {toss}: {wrong}", toss)
        else:
            self._report(toss, joined, file)

    def _report(self, toss: int, joined: Joined, file: FileId) -> None:
        report = self.together.report(joined, self._waited_s(file))
        self.result.looked_at.append(toss)
        self._written(lambda: self.writer.toss(report))
        self._written(self._write_shape)
        self._written(self._write_scene)
        self._say("verdict", f"{report.text()}, {report.seconds:.1f} s after it was recorded", toss)
        self._say_next(toss)

    def _say_next(self, toss: int | None) -> None:
        unseen, found = self.together.unseen_share(), self.together.next()
        shape = "" if unseen is None else f"shape so far: {100 * unseen:.0f} % of it not seen. "
        if found:
            self._say("next", f"{shape}Next: {found[0].text}", toss)

    def _write_shape(self) -> None:
        if self.together.shape is not None:
            write_shape(self.writer.folder, self.together.shape)

    def _write_scene(self) -> None:
        """What the live pose needs beside the shape."""
        if self.looker.shared is not None:
            StaticScene.read(self.looker.shared.scene.folder).write(self.writer.folder)
            scale = Rig.read(self.looker.shared.rig.folder).depth_scale
            write_json(self.writer.folder / "front.json", {"depth_scale": scale})

    def _forget(self, toss: int, why: str) -> None:
        self.done.pop(toss, None)
        self.together.remove(toss)
        self.writer.without(toss)
        if toss in self.result.looked_at:
            self.result.looked_at.remove(toss)
        self.side.forget()
        self._say("left out", f"toss {toss} {why}: left out of everything so far", toss)

    def _idle(self) -> bool:
        """What makes the next toss's look better, or what was said surer; True where something was done."""
        placed = tuple(sorted(self.together.tosses))
        if len(placed) >= 2 * max(len(self.looker.learned_from), 1):
            with contextlib.suppress(TosslabError, OSError):  # a toss may go while it is read: the old scene stays
                self.looker.learn_scene_again(placed)
                return True
            self.looker.learned_from = placed
        if (found := self.side.result()) is not None:
            self.together.law = found
            self._say("learned", f"so far: {found.text()} (95 %), from {len(placed)} tosses")
            self._say_next(None)
            return True
        self.side.start(placed, self.together.learn_law)
        return False

    def _report_lag(self, files: dict[int, FileId], waiting: list[int]) -> None:
        behind_s = max(self._waited_s(files[t]) for t in waiting)
        if len(waiting) > 1 and behind_s > max(self.live.late_s, 2 * self.lag_reported_s):
            self.lag_reported_s = behind_s
            text = f"live: {behind_s:.0f} s behind, {len(waiting)} tosses wait; recording goes on as before"
            self._say("behind", text)

    def _waited_s(self, file: FileId) -> float:
        """Since the toss was recorded; of those that were there before, since the follower began."""
        return time.time() - max(file.changed_ns / 1e9, self.started_s)

    def _state(self, state: str, toss: int | None = None, waiting: int = 0, behind_s: float = 0.0) -> None:
        self._written(lambda: self.writer.state(State(state, os.getpid(), toss, waiting, round(behind_s, 1))))

    def _say(self, kind: Kind, text: str, toss: int | None = None) -> None:
        self.console(text)
        self._written(lambda: self.writer.say(kind, text, toss))

    def _written(self, write: Callable[[], object]) -> None:
        """A disk that refuses ends the following, never the recording."""
        try:
            write()
        except (OSError, TosslabError) as refused:
            self.result.why = self.result.why or f"what is found cannot be written ({refused}); recording goes on"


def alive(process: int) -> bool:
    """Whether a process is there."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # it is there, and another user's
    return True
