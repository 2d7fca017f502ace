"""The system's libraries that pip cannot bring: says which are missing, and brings them where it may.

Runs before the virtual environment is filled: only the standard library here.
    python3 tools/check_system.py --for demo                # what is missing, what to type; exit code 1 if so
    python3 tools/check_system.py --for test --bring .venv  # installs it, as root or with sudo that asks nothing; else
                                                            # unpacks it into .venv; goes on in any case
`--for demo`: what every command needs; `test`: also the developers' packages; `rig`: also cameras and rerun's pictures.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))
from recordings.system_libraries import DEVELOPERS, NEEDED, PICTURES, RIG, install_line

RIG_PROGRAMS = {"arv-fake-gv-camera-0.8": "aravis-tools"}  # the camera that the driver's tests talk to
VULKAN_DRIVERS = ("/usr/share/vulkan/icd.d", "/etc/vulkan/icd.d")
VULKAN_PACKAGE = "mesa-vulkan-drivers"  # lavapipe: rerun's pictures on machines without a GPU
BESIDE = ("libglvnd0", "libglx0", "libxcb1", "libxau6", "libxdmcp6", "libbsd0", "libmd0")
"""What the packages of `NEEDED` load in their turn. The drivers that they depend on are left out: nothing draws."""
LIBRARIES = {
    "demo": NEEDED,
    "test": NEEDED | DEVELOPERS,
    "rig": NEEDED | DEVELOPERS | RIG | PICTURES,
}
FOLDER = Path("lib") / "tosslab"  # as recordings.system_libraries.unpacked_folder has it


def loads(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def missing_packages(purpose: str, unpacked: Path | None = None) -> list[str]:
    """Debian's names of what is missing; what lies in the folder `unpacked` is not."""
    missing = [
        package
        for library, package in LIBRARIES[purpose].items()
        if not loads(library) and not (unpacked is not None and (unpacked / library).exists())
    ]
    if purpose == "rig":
        missing += [package for program, package in RIG_PROGRAMS.items() if shutil.which(program) is None]
        if not any(list(Path(folder).glob("*.json")) for folder in VULKAN_DRIVERS):
            missing.append(VULKAN_PACKAGE)
    return missing


def say(text: str) -> None:
    print(f"set-up: {text}", file=sys.stderr, flush=True)


def bring(venv: Path, purpose: str) -> None:
    """Install what is missing where this user may, else unpack it; what is left is said with a line to copy."""
    folder = venv / FOLDER
    missing = missing_packages(purpose, folder)
    if not missing:
        return
    if shutil.which("apt-get") is None:
        say(f"no apt-get here; your package manager has what Debian calls {' '.join(missing)}")
        return
    prefix = as_root()
    if prefix is not None:
        say(f"installs the system's packages {' '.join(missing)}")
        install(prefix, missing)
    else:
        say(f"may not install the system's packages {' '.join(missing)}: unpacks their libraries into {folder}")
        unpack(missing, folder)
    still = missing_packages(purpose, folder)
    if still:
        say(f"goes on without {' '.join(still)}; as root, type:\n{install_line(still)}")


def as_root() -> list[str] | None:
    """How to run a command as root without a question: [] as root; None where that cannot be."""
    if os.geteuid() == 0:
        return []
    sudo = ["sudo", "-n", "--preserve-env=DEBIAN_FRONTEND"]
    if shutil.which("sudo") and subprocess.run([*sudo, "true"], capture_output=True).returncode == 0:
        return sudo
    return None


def install(prefix: list[str], packages: list[str]) -> bool:
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    steps = (["update", "-q"], ["install", "-q", "-y", "--no-install-recommends", *packages])
    return all(quietly([*prefix, "apt-get", *words], environment) for words in steps)


def unpack(packages: list[str], folder: Path) -> None:
    """Keep these packages' libraries, and what those load in their turn, in `folder`."""
    with unpacked([*packages, *BESIDE]) as root:
        keep(root, folder)


@contextmanager
def unpacked(packages: list[str]) -> Iterator[Path]:
    """A folder with the files of packages that any user may download (apt's lists and files in it too), then gone."""
    with tempfile.TemporaryDirectory() as scratch:
        own = Path(scratch)
        for name in ("state/lists/partial", "cache/archives/partial", "files", "root"):
            (own / name).mkdir(parents=True)
        options = [
            f"Dir::State={own / 'state'}",
            "Dir::State::status=/var/lib/dpkg/status",
            f"Dir::Cache={own / 'cache'}",
        ]
        apt = ["apt-get", "-q", *(word for option in options for word in ("-o", option))]
        if quietly([*apt, "update"]):
            for package in dict.fromkeys(packages):
                quietly([*apt, "download", package], cwd=own / "files")
        for file in sorted((own / "files").glob("*.deb")):
            quietly(["dpkg-deb", "-x", str(file), str(own / "root")])
        yield own / "root"


def keep(root: Path, folder: Path) -> None:
    """Copy the libraries under `root` flat into `folder`, each once, under the name that programs ask for. One that is
    there is replaced, never written into: this very process may have it loaded."""
    folder.mkdir(parents=True, exist_ok=True)
    found = [*root.glob("usr/lib/*/*.so.*"), *root.glob("lib/*/*.so.*")]
    named = {path.resolve() for path in found if path.is_symlink()}
    for path in found:
        if path.is_symlink() or path.resolve() not in named:
            shutil.copy(path.resolve(), fresh := folder / f"{path.name}.new")
            fresh.replace(folder / path.name)


def quietly(command: list[str], environment: dict[str, str] | None = None, cwd: Path | None = None) -> bool:
    """Run it; where it fails, say its last line."""
    done = subprocess.run(command, env=environment, cwd=cwd, capture_output=True, text=True)
    if done.returncode:
        last = (done.stderr.strip() or done.stdout.strip() or "no word").splitlines()[-1]
        say(f"`{' '.join(command[:1] + command[-2:])}` failed: {last}")
    return done.returncode == 0


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--for", dest="purpose", choices=LIBRARIES, default="demo")
    parser.add_argument("--bring", type=Path, metavar="VENV")
    args = parser.parse_args()
    if not sys.platform.startswith("linux"):
        return 0  # elsewhere the wheels bring what they need
    if args.bring is not None:
        bring(args.bring, args.purpose)
        return 0
    missing = missing_packages(args.purpose)
    if missing:
        say(f"not on this system: {' '.join(missing)}; as root, type:\n{install_line(missing)}")
    return 1 if missing else 0


if __name__ == "__main__":
    sys.exit(main())
