"""A small network that tells a session's object from its scene, pixel by pixel, learned from its own masks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray as Array

LAYERS = 3


@dataclass(frozen=True)
class NetworkSettings:
    """How the network learns. A share of its labels is wrong: they are what it is to mend."""

    hidden: int = 32
    steps: int = 500
    batch: int = 2048
    rate: float = 4e-3
    decay: float = 1e-4
    robust: float = 0.5
    """q of the generalised cross entropy (1 - p^q) / q (Zhang and Sabuncu, "Generalized Cross Entropy Loss for Training
    Deep Neural Networks with Noisy Labels", NeurIPS 2018): 0 is cross entropy, which follows wrong labels; 1 the mean
    absolute error, which does not, and blurs borders. Swept over ten generated sessions."""
    pixels: int = 500
    """So many of the object's pixels of a frame are learned from, and so many of the others, ..."""
    near_px: float = 5.0
    """... half of those from this near to the object."""


@dataclass(frozen=True, eq=False)
class PixelNetwork:
    """A learned network: features are made of mean 0 and deviation 1, then come three layers."""

    mean: Float32[Array, " f"]
    spread: Float32[Array, " f"]
    weights: tuple[Float32[Array, "_ _"], ...]
    biases: tuple[Float32[Array, " _"], ...]

    def log_odds(self, features: Float32[Array, "a b f"]) -> Float32[Array, "a b"]:
        """Of the object against all else, where they are as frequent as in the samples learned from (`log_share`)."""
        first = self.weights[0] / self.spread
        x = features.reshape(-1, features.shape[-1]) @ first.T
        x += self.biases[0] - first @ self.mean
        for weight, bias in zip(self.weights[1:], self.biases[1:], strict=True):
            x = np.maximum(x, 0.0, out=x) @ weight.T
            x += bias
        return np.asarray(x[:, 0].reshape(features.shape[:2]), dtype=np.float32)

    def arrays(self, name: str) -> dict[str, Float32[Array, "..."]]:
        """What a file keeps of it."""
        kept = {f"{name}.mean": self.mean, f"{name}.spread": self.spread}
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            kept |= {f"{name}.weight{k}": weight, f"{name}.bias{k}": bias}
        return kept

    @staticmethod
    def of(arrays: Mapping[str, Float32[Array, "..."]], name: str) -> PixelNetwork:
        """From what `arrays` gave."""
        weights, biases = (tuple(arrays[f"{name}.{part}{k}"] for k in range(LAYERS)) for part in ("weight", "bias"))
        return PixelNetwork(arrays[f"{name}.mean"], arrays[f"{name}.spread"], weights, biases)


def samples_of(
    features: Float32[Array, "a b f"],
    mask: Bool[Array, "a b"],
    outside_px: Float32[Array, "a b"],
    s: NetworkSettings,
    seed: tuple[int, ...],
) -> tuple[Float32[Array, "n f"], Bool[Array, " n"]]:
    """Pixels of one frame to learn from, and whether each is the object's. `outside_px`: their distance from it."""
    rng = np.random.default_rng(seed)
    near, anywhere = (outside_px > 0) & (outside_px < s.near_px), outside_px > 0
    rows, labels = [], []
    for where, wanted, label in (
        (mask, s.pixels, True),
        (near, s.pixels // 2, False),
        (anywhere, s.pixels // 2, False),
    ):
        pixels = np.flatnonzero(where)
        if len(pixels):
            chosen = rng.choice(pixels, wanted, replace=len(pixels) < wanted)
            rows.append(features.reshape(-1, features.shape[-1])[chosen])
            labels.append(np.full(wanted, label))
    return np.concatenate(rows), np.concatenate(labels)


def log_share(mask: Bool[Array, "a b"], outside_px: Float32[Array, "a b"], s: NetworkSettings) -> float:
    """To be added to the network's log-odds near a mask's border: `samples_of` takes pixels of the object, and of all
    else, not as often as there are of them."""
    near, anywhere = ((outside_px > 0) & (outside_px < s.near_px)).sum(), (outside_px > 0).sum()
    return float(np.log(max(mask.sum(), 1) * (0.5 / max(near, 1) + 0.5 / max(anywhere, 1))))


def learned(features: Float32[Array, "n f"], labels: Bool[Array, " n"], s: NetworkSettings) -> PixelNetwork:
    """The network that tells these pixels apart, whatever few wrong labels say."""
    import torch

    from processing.engine.adam import Adam

    mean, spread = features.mean(0), features.std(0) + 1e-2
    rows, wanted = torch.from_numpy((features - mean) / spread), torch.from_numpy(labels)
    random = torch.Generator().manual_seed(0)
    sizes = (features.shape[1], s.hidden, s.hidden, 1)
    layers = [torch.nn.Linear(i, o) for i, o in zip(sizes[:-1], sizes[1:], strict=True)]
    with torch.no_grad():
        for layer in layers:  # PyTorch's own start, with random numbers of our own
            reach = layer.in_features**-0.5
            layer.weight.uniform_(-reach, reach, generator=random)
            layer.bias.uniform_(-reach, reach, generator=random)
    parameters = [p for layer in layers for p in layer.parameters()]
    optimizer = Adam(parameters, s.rate, s.decay)
    for _ in range(s.steps):
        chosen = torch.randint(len(rows), (s.batch,), generator=random)
        x = rows[chosen]
        for layer in layers[:-1]:
            x = torch.relu(layer(x))
        odds = layers[-1](x)[:, 0]
        right = torch.sigmoid(torch.where(wanted[chosen], odds, -odds)).clamp(min=1e-4)
        loss = ((1 - right**s.robust) / s.robust).mean()
        loss.backward()
        optimizer.step()
    weights = tuple(layer.weight.detach().numpy() for layer in layers)
    return PixelNetwork(mean, spread, weights, tuple(layer.bias.detach().numpy() for layer in layers))
