"""Stages as jobs of a Slurm cluster without accounting: judged by their markers, the same as in processes here."""

from __future__ import annotations

import contextlib
import os
import pwd
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import cloudpickle
import pytest

from processing.engine.each import Engine, SideBySide
from processing.engine.slurm import slurm_jobs
from processing.engine.workers import Worker
from processing.store import Store
from recordings.errors import BadInput, TosslabError
from recordings.progress import Board

cloudpickle.register_pickle_by_value(sys.modules[__name__])  # a job's process cannot import a test

PACKAGES = ("slurmctld", "slurmd", "slurm-client", "slurm-wlm-basic-plugins")
LIBRARIES = [
    "libmunge2",
    "libhwloc15",
    "libnuma1",
    "libpam0g",
    "liblz4-1",
    "libdbus-1-3",
    "libjson-c5",
    "liblua5.1-0",
    "libyaml-0-2",
]
CONFIG = """ClusterName=one
SlurmctldHost={host}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
AuthType=auth/none
CredType=cred/none
PluginDir={plugins}
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
StateSaveLocation={state}/controller
SlurmdSpoolDir={state}/node
SlurmctldPidFile={state}/controller.pid
SlurmdPidFile={state}/node.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
JobAcctGatherType=jobacct_gather/none
AccountingStorageType=accounting_storage/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
MpiDefault=none
ReturnToService=2
KillWait=2
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs=8 RealMemory=64000 State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP
"""


@dataclass(frozen=True)
class Kind:
    kind: str
    numbers: tuple[float | None, ...]


def stage(engine: Engine, folder: Path, kind: str) -> Kind | str:
    """`plain` gives a result, `dies` is killed, `fails` raises, `waits` waits where it is started for the first time
    and there is a file `hang`. The stage's result, or what was raised."""

    def compute(_: Path) -> Kind:
        with open(folder / f"{kind}.starts", "a") as starts:
            starts.write(f"{os.getpid()}\n")
        if kind == "dies":
            os.kill(os.getpid(), signal.SIGKILL)
        if kind == "fails":
            raise BadInput("two is not three")
        if kind == "waits" and (folder / "hang").exists() and len((folder / f"{kind}.starts").read_text().split()) == 1:
            time.sleep(600)
        return Kind(kind, (1.5, None))

    folder.mkdir(exist_ok=True)
    try:
        return Store(folder / "results", engine).run(kind, 1, {}, {}, Kind, compute).result
    except TosslabError as wrong:
        return f"{type(wrong).__name__}: {wrong}"


def stages(engine: Engine, folder: Path, *kinds: str) -> list[Kind | str]:
    return list(engine.each(kinds, lambda kind: stage(engine, folder, kind)).values())


@contextlib.contextmanager
def on_slurm(folder: Path) -> Iterator[SideBySide]:
    board = Board()
    with SideBySide(slurm_jobs(4, folder / "logs"), board) as engine:
        yield engine


@contextlib.contextmanager
def here() -> Iterator[SideBySide]:
    board = Board()
    with SideBySide([Worker(board), Worker(board)], board) as engine:
        yield engine


@dataclass
class Slurm:
    """One controller and one node, unpacked from Debian's packages, run by whoever runs the test."""

    root: Path
    state: Path
    host: str
    environment: dict[str, str]
    running: dict[str, subprocess.Popen] = field(default_factory=dict)

    def start(self, name: str, *arguments: str) -> None:
        with open(self.state / f"{name}.log", "ab") as log:
            command = [str(self.root / "usr" / "sbin" / f"{name}-wlm"), "-D", *arguments]
            environment = {**os.environ, **self.environment}
            self.running[name] = subprocess.Popen(command, stdout=log, stderr=log, env=environment)

    def start_node(self) -> None:
        for left in (self.state / "node").glob("job*"):  # of a job that lost its power; slurmd fails to make it anew
            shutil.rmtree(left)
        self.start("slurmd", "-N", self.host, "-d", str(self.root / "usr" / "sbin" / "slurmstepd-wlm"))

    def say(self, *command: str) -> str:
        done = subprocess.run(
            command, env={**os.environ, **self.environment}, capture_output=True, text=True, check=False
        )
        return done.stdout + done.stderr

    def wait_for(self, what: Callable[[], bool], seconds: float = 90) -> None:
        until = time.monotonic() + seconds
        while not what():
            if time.monotonic() > until:
                logs = "\n".join((self.state / f"{n}.log").read_text()[-800:] for n in self.running)
                raise AssertionError(f"waited {seconds} s; {self.say('sinfo')}{self.say('squeue')}{logs}")
            time.sleep(0.3)

    def idle(self) -> bool:
        return self.say("sinfo", "--noheader", "--format=%T").strip() == "idle"

    def pull_the_plug(self) -> None:
        """Kill the node's daemon and every process that it started, as a power failure does."""
        self.running["slurmd"].kill()
        self.running["slurmd"].wait()
        steps = [p for p in Path("/proc").glob("[0-9]*") if _runs(p, self.root / "usr" / "sbin" / "slurmstepd-wlm")]
        children = [child for step in steps for child in _descendants(int(step.name))]
        for process in [*(int(step.name) for step in steps), *children]:  # steps first: they would report the end
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)

    def stop(self) -> None:
        self.pull_the_plug()
        for process in self.running.values():
            process.kill()
            process.wait()


def _runs(process: Path, program: Path) -> bool:
    try:
        return os.readlink(process / "exe") == str(program)
    except OSError:
        return False


def _descendants(process: int) -> list[int]:
    try:
        children = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    return [d for child in map(int, children) for d in (*_descendants(child), child)]


def _unpacked(cache: Path) -> Path:
    """Debian's packages in a folder of the cache; the test is skipped where they cannot be had."""
    root = cache / "root"
    if (root / "usr" / "sbin" / "slurmd-wlm").exists():
        return root
    if shutil.which("apt-get") is None or shutil.which("dpkg") is None:
        pytest.skip("no apt-get and dpkg here: the test unpacks Debian's packages of Slurm")
    if not any(Path("/sys/fs/cgroup").glob("*")):
        pytest.skip("no cgroup is mounted here (/sys/fs/cgroup is empty): Slurm's daemon does not start without")
    cache.mkdir(parents=True, exist_ok=True)
    for package in (*PACKAGES, *LIBRARIES):
        done = subprocess.run(["apt-get", "download", package], cwd=cache, capture_output=True, text=True, check=False)
        if done.returncode != 0 and package in PACKAGES:
            pytest.skip(f"Debian's package {package} cannot be had: {(done.stderr.splitlines() or ['?'])[-1]}")
    for file in cache.glob("*.deb"):
        subprocess.run(["dpkg", "-x", str(file), str(root)], check=True)
    return root


def _free_ports(count: int) -> list[int]:
    opened = [socket.socket() for _ in range(count)]
    for one in opened:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in opened]
    for one in opened:
        one.close()
    return ports


@pytest.fixture
def slurm(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Slurm]:
    """A cluster of this machine alone. `TOSSLAB_SLURM` may name a folder that keeps the unpacked packages."""
    state = tmp_path_factory.mktemp("slurm")
    cache = os.environ.get("TOSSLAB_SLURM")
    root = _unpacked(Path(cache) if cache else state / "packages").resolve()
    libraries = root / "usr" / "lib" / f"{os.uname().machine}-linux-gnu"
    host, user = socket.gethostname().split(".")[0], pwd.getpwuid(os.getuid()).pw_name
    config = CONFIG.format(host=host, user=user, state=state, plugins=libraries / "slurm-wlm", ports=_free_ports(2))
    (state / "slurm.conf").write_text(config)
    for name in ("controller", "node"):
        (state / name).mkdir()
    environment = {
        "SLURM_CONF": str(state / "slurm.conf"),
        "LD_LIBRARY_PATH": f"{libraries}:{libraries / 'slurm-wlm'}:{root / 'lib' / libraries.name}",
        "PATH": f"{root / 'usr' / 'bin'}:{os.environ['PATH']}",
    }
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    cluster = Slurm(root, state, host, environment)
    cluster.start("slurmctld")
    time.sleep(1)
    cluster.start_node()
    try:
        cluster.wait_for(cluster.idle)
        yield cluster
    finally:
        cluster.stop()


def _fail_the_node(slurm: Slurm, starts: Path) -> None:
    """While a job runs: its node loses power, is found down, comes back."""
    slurm.wait_for(starts.exists)
    slurm.pull_the_plug()
    slurm.say("scontrol", "update", f"NodeName={slurm.host}", "State=DOWN", "Reason=power")
    slurm.wait_for(lambda: "waits" in starts.name and "PENDING" in slurm.say("squeue", "--noheader", "--format=%T"))
    slurm.start_node()
    slurm.say("scontrol", "update", f"NodeName={slurm.host}", "State=RESUME")
    job = slurm.say("squeue", "--noheader", "--format=%A", "--states=PENDING").split()[0]
    slurm.say("scontrol", "update", f"JobId={job}", "StartTime=now")  # Slurm lets a requeued job wait for two minutes


@pytest.mark.slow
def test_slurm_without_accounting_gives_what_local_gives_when_jobs_are_killed_and_the_node_fails(
    slurm: Slurm, tmp_path: Path, capfd: pytest.CaptureFixture
) -> None:
    assert "disabled" in slurm.say("sacct")  # the cluster that this is about
    with here() as engine:
        wanted = stages(engine, tmp_path / "here", "plain", "dies", "fails", "waits")

    there = tmp_path / "there"
    there.mkdir()
    (there / "hang").touch()
    with on_slurm(there) as engine:
        found = stages(engine, there, "plain", "dies", "fails")
        failing = threading.Thread(target=_fail_the_node, args=(slurm, there / "waits.starts"))
        failing.start()
        found += stages(engine, there, "waits")
        failing.join()

    assert len((there / "waits.starts").read_text().split()) == 2  # it was queued again, and ran anew
    assert [r if isinstance(r, Kind) else r.split(":")[0] for r in found] == [
        r if isinstance(r, Kind) else r.split(":")[0] for r in wanted
    ]
    assert found[2] == "BadInput: two is not three"
    assert sorted(p.name.split("-")[0] for p in (there / "results").iterdir()) == ["plain", "waits"]
    said = capfd.readouterr()
    assert "sacct" not in said.out + said.err
    assert "submitit" not in said.out + said.err


@pytest.mark.slow
def test_a_job_that_is_cancelled_on_slurm_ends_without_a_result(slurm: Slurm, tmp_path: Path) -> None:
    there = tmp_path / "there"
    there.mkdir()
    (there / "hang").touch()

    def cancel() -> None:
        slurm.wait_for((there / "waits.starts").exists)
        slurm.say("scancel", "--name=tosslab")

    cancelling = threading.Thread(target=cancel)
    cancelling.start()
    with on_slurm(there) as engine:
        (found,) = stages(engine, there, "waits")
    cancelling.join()
    assert isinstance(found, str)
    assert "ended without a result" in found
    assert list((there / "results").iterdir()) == []


def test_without_slurm_it_is_said_what_to_type(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(BadInput, match="--executor local"):
        slurm_jobs(2, tmp_path)
