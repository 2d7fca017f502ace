"""What every test may ask for: the shared data (or a skip that says why it is not there), the shipped sample."""

from __future__ import annotations

import contextlib
import os
import resource
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from hypothesis import settings

if TYPE_CHECKING:
    from recordings.session import Session

ROOT = Path(__file__).resolve().parent.parent
DATA = Path(os.environ.get("TOSSLAB_DATA", ROOT.parent / "shared" / "data"))

# No deadlines: the machine is shared. In CI the same examples every time.
settings.register_profile("tosslab", deadline=None, derandomize="CI" in os.environ)
settings.load_profile("tosslab")


# Programs that tests kill leave no core file (theirs are inherited from here).
resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))

REAL_TIME = (
    "acquisition/drivers/",
    "acquisition/simulators/",
    "acquisition/test_recorder.py",
    "acquisition/test_faults.py",
)
"""What talks to devices against the clock: one at a time, whatever else runs."""
TOGETHER = "real time"


def _process(nodeid: str) -> str:
    """The name of what runs in one process: a file's tests, for its fixtures; all that are in real time."""
    file = nodeid.partition("::")[0].removeprefix("tests/")
    return TOGETHER if file.startswith(REAL_TIME) else file


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """pytest-xdist's own `loadgroup` groups nothing with pytest 9.2, and says nothing."""
    from xdist.scheduler import LoadScopeScheduling

    class ByProcess(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return _process(nodeid)

    return ByProcess(config, log)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """A test in real time, and what it starts, goes before other processes where this user may (root)."""
    if _process(item.nodeid) != TOGETHER:
        return (yield)
    usual = os.getpriority(os.PRIO_PROCESS, 0)
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, -10)
    try:
        return (yield)
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, usual)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Generator[None, object, object]:
    """A test that plays a full disk limits the size of this process's files: pytest's own log must not meet that."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        return (yield)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """`data("cube_dev")` is that folder of the shared data; the test is skipped where it is absent."""

    def find(name: str) -> Path:
        path = DATA / name
        if not path.exists():
            pytest.skip(f"no {path}: set TOSSLAB_DATA to the folder that holds {name.split('/')[0]}")
        return path

    return find


@pytest.fixture(scope="session")
def sample_path() -> Path:
    """The session that the repository ships."""
    return ROOT / "recordings" / "samples" / "box_toss"


@pytest.fixture
def sample_session(sample_path: Path) -> Session:
    from recordings.session import Session

    return Session.open(sample_path)
