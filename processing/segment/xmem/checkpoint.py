"""XMem's published checkpoint: where it comes from, its layers, and a network that carries it.

The published file could not be reached from where this was written: that our network loads and runs it is shown with
random weights of the same names and shapes only. `layers.txt` has those, a line a layer, with sizes in PyTorch's
order (`-` for a single number).
"""

from __future__ import annotations

from pathlib import Path

import torch

from processing.published_weights import XMEM, check_layers, find_weights, read_weights
from processing.segment.xmem.network import XMemNetwork

COUNTERS = "num_batches_tracked"
"""Layers of this name count training steps: files may leave them out, and they change nothing."""


def published_layers() -> dict[str, tuple[int, ...]]:
    """Shape of every layer of the published checkpoint by name."""
    lines = Path(__file__).with_name("layers.txt").read_text(encoding="utf-8").splitlines()
    return {name: () if size == "-" else tuple(map(int, size.split("x"))) for name, size in map(str.split, lines)}


def load_network(folder: Path | None) -> XMemNetwork:
    """The published network with the weights in a user's folder, ready to run. Raises BadInput."""
    path = find_weights(XMEM, folder)
    stored = read_weights(path, XMEM)
    layers = published_layers()
    counters = {n: torch.zeros((), dtype=torch.int64) for n in layers if n.endswith(COUNTERS)}
    stored = counters | stored
    check_layers(stored, layers, path, XMEM)
    with torch.device("meta"):  # no random numbers for what is replaced at once
        network = XMemNetwork()
    network.load_state_dict({n: t.float() if t.is_floating_point() else t for n, t in stored.items()}, assign=True)
    return network.eval()
