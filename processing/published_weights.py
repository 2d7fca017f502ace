"""Learned weights that a user brings: where they come from, whether they are there, whether they are the right ones.

Nothing is ever downloaded. A file is read as tensors alone (`weights_only`); each layer has its name and shape checked.
"""

from __future__ import annotations

import pickletools
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from recordings.errors import BadInput

if TYPE_CHECKING:
    from torch import Tensor

LEGACY_PICKLES = 5
"""Before the numbers of a file by torch older than 1.6: magic, protocol, system, tensors, their order."""
Shapes = Mapping[str, tuple[int, ...]]


@dataclass(frozen=True)
class WeightFile:
    """A published file: what asks for it, as typed; the names under which it is looked for (the first one there is
    taken); where it comes from."""

    option: str
    names: tuple[str, ...]
    source: str
    megabytes: int

    def __str__(self) -> str:
        return f"{' or '.join(self.names)} (about {self.megabytes} MB) of {self.source}"


XMEM = WeightFile(
    "--segmenter xmem", ("XMem-s012.pth", "XMem.pth"), "release v1.0 of the GitHub project hkchengrex/XMem", 249
)
LOFTR = WeightFile(
    "--matcher loftr",
    ("loftr_outdoor.ckpt",),
    "LoFTR's outdoor model as kornia has it (kornia/loftr, Hugging Face)",
    46,
)
XFEAT = WeightFile(
    "--matcher xfeat", ("xfeat.pt",), "the folder weights of the GitHub project verlab/accelerated_features", 6
)
LIGHTGLUE = WeightFile(
    "--matcher lightglue", ("sift_lightglue.pth",), "release v0.1_arxiv of the GitHub project cvg/LightGlue", 48
)
PUBLISHED = {"xmem": XMEM, "loftr": LOFTR, "xfeat": XFEAT, "lightglue": LIGHTGLUE}
"""By the name of the backend that reads it."""


def find_weights(file: WeightFile, folder: Path | None) -> Path:
    """The file in the user's folder. Raises BadInput."""
    if folder is None:
        raise BadInput(
            f"{file.option} needs learned weights and no --weights DIR was given; "
            f"wanted: a folder that holds {file}. Get it there, then run with {file.option} --weights DIR"
        )
    if not folder.is_dir():
        raise BadInput(f"--weights {folder}: there is no such folder; wanted: a folder that holds {file}")
    for name in file.names:
        if (folder / name).is_file():
            return folder / name
    there = ", ".join(sorted(p.name for p in folder.iterdir())[:8]) or "nothing"
    raise BadInput(f"{file.option}: found {there} in {folder}; wanted: {file}. Put it there, under that name")


def read_weights(path: Path, file: WeightFile, inside: str | None = None) -> dict[str, Tensor]:
    """The tensors of a checkpoint by layer name, those under the key `inside` where there is one. Raises BadInput."""
    import torch

    try:
        _check_container(path)
        stored: Any = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as wrong:  # torch's unpickler raises whatever a hostile file makes it raise
        reason = str(wrong).strip().splitlines() or [type(wrong).__name__]
        raise BadInput(f"{path} is no readable checkpoint ({reason[0][:120]}); wanted: {file}. Get it again") from wrong
    if isinstance(stored, Mapping) and inside is not None and inside in stored:
        stored = stored[inside]
    if not isinstance(stored, Mapping) or not all(isinstance(v, torch.Tensor) for v in stored.values()):
        raise BadInput(f"{path} holds no tensors by layer name; wanted: {file}")
    return {str(k): v for k, v in stored.items()}


def _check_container(path: Path) -> None:
    """As torch.save packs: nothing compressed or over another, pickles of a network's length. Raises ValueError."""
    with open(path, "rb") as file:
        if not zipfile.is_zipfile(file):
            file.seek(0)
            return _check_pickles(file, LEGACY_PICKLES)
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        if any(e.compress_type != zipfile.ZIP_STORED for e in entries):
            raise ValueError("its parts are compressed, which torch.save never does")
        if sum(e.file_size for e in entries) > path.stat().st_size:
            raise ValueError("its parts lie over one another")
        for entry in entries:
            if entry.filename.endswith(".pkl"):
                with archive.open(entry) as file:
                    _check_pickles(file, 1)


def _check_pickles(file: Any, count: int) -> None:
    """Walk the opcodes, which builds nothing."""
    from recordings.bounded.limits import MOST_PICKLE_STEPS

    steps = 0
    for _ in range(count):
        for opcode, argument, _ in pickletools.genops(file):
            steps += 1
            if steps > MOST_PICKLE_STEPS:
                raise ValueError(f"its pickle has more than {MOST_PICKLE_STEPS} steps")
            if opcode.name == "GLOBAL" and str(argument).split()[0] in ("builtins", "__builtin__", "_codecs"):
                raise ValueError(f"its pickle asks for {argument}, which tensors do not need")


def check_layers(found: Mapping[str, Tensor], wanted: Shapes, path: Path, file: WeightFile) -> None:
    """Refuse weights whose layers are not the wanted ones, by name and shape. Raises BadInput that shows some."""
    shapes = {name: tuple(tensor.shape) for name, tensor in found.items()}
    wrong = [f"no {name}" for name in wanted if name not in shapes]
    wrong += [f"unknown {name}" for name in shapes if name not in wanted]
    wrong += [f"{n} is {shapes[n]}, wanted {wanted[n]}" for n in wanted if n in shapes and shapes[n] != wanted[n]]
    if wrong:
        more = f" and {len(wrong) - 3} more" if len(wrong) > 3 else ""
        raise BadInput(f"{path} holds other layers: {'; '.join(wrong[:3])}{more}; wanted: {file}")
