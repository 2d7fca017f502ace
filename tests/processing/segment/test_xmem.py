"""XMem's architecture and memories, with random weights: the published ones are not at hand."""

from __future__ import annotations

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from processing.segment.xmem.checkpoint import load_network, published_layers
from processing.segment.xmem.memory import (
    Elements,
    Memory,
    MemorySettings,
    consolidated,
    similarity,
    top_softmax,
    without_least_used,
)
from processing.segment.xmem.network import Widths, XMemNetwork
from processing.segment.xmem.segmenter import Frame, Pass, XMemSegmenter, XMemSettings, confidence
from recordings.errors import BadInput

SMALL = Widths(base=8, key=8, value=16, hidden=8, deep=32, shallow=16)
SETTINGS = MemorySettings(every=2, working_most=3, working_least=2, prototypes=6, long_most=10, top_k=5)
HEIGHT, WIDTH = 64, 80
CELLS = (HEIGHT // 16) * (WIDTH // 16)

GOLDEN = (
    (0.641583, 0.092987, 0.724733, 0.712835),
    (0.641215, 0.092408, 0.737827, 0.682213),
    (0.636153, 0.092158, 0.734248, 0.714194),
    (0.634103, 0.090399, 0.684346, 0.719164),
    (0.642445, 0.090474, 0.697414, 0.675413),
    (0.640702, 0.096405, 0.724763, 0.678242),
    (0.633137, 0.090269, 0.703380, 0.687491),
    (0.634952, 0.091259, 0.679852, 0.674569),
)
"""Mean, deviation and two pixels of the probabilities by the published code (hkchengrex/XMem at f3b841d, torch 2.13),
run once on these weights, frames and memory sizes. Float32 sums in another order differ by 1e-6; 2e-5 leaves room."""


def empty(widths: Widths) -> XMemNetwork:
    """Shapes without numbers."""
    with torch.device("meta"):
        return XMemNetwork(widths)


def random_weights(widths: Widths, seed: int = 0) -> XMemNetwork:
    """Weights by layer in order: normal with deviation 1 / sqrt(inputs); normalisations do nothing, biases are 0."""
    rng, network = np.random.default_rng(seed), empty(widths)
    weights = {}
    for name, layer in network.state_dict().items():
        shape = tuple(layer.shape)
        if layer.ndim > 1:
            values = rng.standard_normal(shape, dtype=np.float32) / np.float32(np.sqrt(np.prod(shape[1:])))
        elif name.endswith(("weight", "running_var")):
            values = np.ones(shape, np.float32)
        else:
            values = np.zeros(shape, np.float32)
        weights[name] = torch.tensor(values * np.float32(0.1 if name == "decoder.pred.weight" else 1))
    network.load_state_dict(weights, assign=True)
    return network.eval()


@pytest.fixture(scope="module")
def small() -> XMemNetwork:
    return random_weights(SMALL)


def video(count: int) -> np.ndarray:
    return np.random.default_rng(1).integers(0, 256, (count, HEIGHT, WIDTH, 3), dtype=np.uint8)


def first_mask() -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[16:48, 24:64] = True
    return mask


def started(network: XMemNetwork, settings: MemorySettings = SETTINGS) -> Pass:
    run = Pass(network, Frame.of(HEIGHT, WIDTH, HEIGHT), XMemSettings(HEIGHT, settings), "cpu")
    run.known(video(1)[0], first_mask())
    return run


def elements(count: int, seed: int = 0, used: list[float] | None = None) -> Elements:
    rng = np.random.default_rng(seed)
    k, e, v = (torch.tensor(rng.random((c, count)), dtype=torch.float32) for c in (4, 4, 3))
    new = Elements.new(k, torch.tensor(1 + rng.random((1, count)), dtype=torch.float32), e, v)
    return new if used is None else replace(new, used=torch.tensor(used), lived=torch.ones(count))


def test_our_layers_are_those_of_the_published_checkpoint() -> None:
    ours = {name: tuple(layer.shape) for name, layer in empty(Widths()).state_dict().items()}
    assert ours == published_layers()


def test_with_the_same_weights_masks_are_those_of_the_published_code() -> None:
    run = started(random_weights(Widths()))
    frames = video(9)
    for i in range(1, 9):
        p = run.follow(frames[i], last=i == 8)
        np.testing.assert_allclose((p.mean(), p.std(), p[20, 30], p[50, 70]), GOLDEN[i - 1], atol=2e-5)
    assert run.memory.long_term is not None
    assert len(run.memory.long_term) == 10


@torch.inference_mode()
def test_features_have_strides_16_8_and_4(small: XMemNetwork) -> None:
    seen = small.encode(torch.zeros(1, 3, HEIGHT, WIDTH))
    assert seen.f16.shape == (1, 128, 4, 5)
    assert seen.f8.shape == (1, 64, 8, 10)
    assert seen.f4.shape == (1, 32, 16, 20)
    assert seen.key.shape == seen.selection.shape == (1, 8, 4, 5)
    assert float(seen.shrinkage.min()) >= 1
    assert float(seen.selection.min()) >= 0
    assert float(seen.selection.max()) <= 1


def test_similarity_is_the_anisotropic_distance() -> None:
    memory, query = elements(5), elements(3, seed=1)
    got = similarity(memory, query.key, query.selection)
    for i in range(5):
        for j in range(3):
            square = query.selection[:, j] * (memory.key[:, i] - query.key[:, j]) ** 2
            assert float(got[i, j]) == pytest.approx(float(-memory.shrinkage[0, i] * square.sum() / 2), abs=1e-5)


def test_a_reading_spreads_one_share_over_the_best_elements() -> None:
    shares = top_softmax(torch.tensor([[3.0, 0.0], [1.0, 5.0], [2.0, 4.0]]), 2)
    torch.testing.assert_close(shares.sum(0), torch.ones(2))
    assert (shares > 0).tolist() == [[True, False], [False, True], [True, True]]
    torch.testing.assert_close(top_softmax(torch.zeros(2, 1), 30), torch.full((2, 1), 0.5))


def test_prototypes_are_the_most_used_and_read_all_candidates() -> None:
    used = [0.1, 0.9, 0.0, 0.5]
    candidates = elements(4, used=used)
    out = consolidated(candidates, 2)
    torch.testing.assert_close(out.key, candidates.key[:, [1, 3]])
    shares = similarity(candidates, out.key, out.selection).softmax(0)
    torch.testing.assert_close(out.value, candidates.value @ shares)
    assert float(out.used.sum()) == 0
    alone = consolidated(elements(1, used=[1.0]), 5)
    torch.testing.assert_close(alone.value, elements(1).value)


def test_the_least_used_leave_and_of_equals_the_older() -> None:
    kept = without_least_used(elements(5, used=[0.5, 0.0, 0.9, 0.0, 0.0]), 3)
    torch.testing.assert_close(kept.used, torch.tensor([0.5, 0.9, 0.0]))
    torch.testing.assert_close(kept.key[:, 2], elements(5).key[:, 4])
    assert len(without_least_used(elements(3), 10)) == 3


def test_usage_is_a_share_per_reading() -> None:
    read = elements(2).read(torch.tensor([[1.0, 0.5], [0.0, 0.5]])).read(torch.tensor([[1.0], [0.0]]))
    torch.testing.assert_close(read.usage, torch.tensor([1.25, 0.25]))


def test_a_memory_reads_back_what_it_was_told() -> None:
    memory = Memory(SETTINGS, torch.zeros(1, 2, 1, 2))
    key = torch.tensor([[[[0.0, 50.0]], [[50.0, 0.0]]]])
    value = torch.tensor([[[[1.0, 2.0]]]])
    memory.add(Elements.new(key, torch.ones(1, 1, 1, 2), torch.ones_like(key), value))
    torch.testing.assert_close(memory.read(key, torch.ones_like(key)), value)


def test_working_memory_stays_within_its_frames_and_keeps_the_first_and_the_last(small: XMemNetwork) -> None:
    run = started(small)
    first = run.memory.working
    assert first is not None
    frames, sizes, long = video(14), [], []
    for frame in frames[1:]:
        run.follow(frame)
        sizes.append(run.memory.working_frames)
        long.append(0 if run.memory.long_term is None else len(run.memory.long_term))
    assert sizes == [1, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2, 2]  # the third one consolidates at once: two are left
    assert long == [0, 0, 0, 6, 6, 10, 10, 10, 10, 10, 10, 10, 10]  # six prototypes each time, never above ten
    assert run.memory.working is not None
    torch.testing.assert_close(run.memory.working.key[:, :CELLS], first.key)
    newest = small.encode(run._frame.image(frames[12], "cpu")).key[0].flatten(1)
    torch.testing.assert_close(run.memory.working.key[:, CELLS:], newest, atol=1e-5, rtol=1e-5)


def test_sensory_memory_changes_in_every_frame_but_the_last(small: XMemNetwork) -> None:
    run = started(small)
    states = [run.memory.sensory]
    for i, frame in enumerate(video(6)[1:]):
        run.follow(frame, last=i == 4)
        states.append(run.memory.sensory)
    change = [float((a - b).abs().max()) for a, b in zip(states, states[1:])]
    assert min(change[:-1]) > 1e-6
    assert change[-1] == 0
    assert float(states[-1].abs().max()) < 1
    run.forget_place()
    assert float(run.memory.sensory.abs().max()) == 0


def test_a_deep_update_takes_the_place_of_the_light_one(small: XMemNetwork) -> None:
    run = started(small)
    run.follow(video(2)[1])
    before = run.memory.sensory.clone()
    run.follow(video(3)[2])  # the second frame is remembered
    assert run.memory.working is not None
    value = run.memory.working.value[:, -CELLS:].reshape(1, -1, 4, 5)
    torch.testing.assert_close(run.memory.sensory, small.reinforced(value, before))


def test_the_same_video_gives_the_same_masks(small: XMemNetwork) -> None:
    def run() -> np.ndarray:
        through = started(small)
        return np.stack([through.follow(frame) for frame in video(8)[1:]])

    np.testing.assert_array_equal(run(), run())


@pytest.mark.parametrize("size", [(120, 160), (50, 75), (48, 48)])
def test_an_image_comes_back_where_it_was(size: tuple[int, int]) -> None:
    frame = Frame.of(*size, short_side_px=48)
    mask = np.zeros(size, dtype=bool)
    mask[10:30, 20:40] = True
    plane = frame.mask(mask, "cpu")
    assert plane.shape[-2] % 16 == plane.shape[-1] % 16 == 0
    assert (plane.shape[-2] // 16, plane.shape[-1] // 16) == frame.cells
    back = frame.back(plane) > 0.5
    assert (back & mask).sum() / (back | mask).sum() > 0.8
    assert back.shape == size


def test_confidence_is_the_expected_overlap() -> None:
    p = np.array([[0.9, 0.7], [0.2, 0.0]], dtype=np.float32)
    assert confidence(p) == pytest.approx(1.6 / 2.2)
    assert confidence((p > 0.5).astype(np.float32)) == 1
    assert confidence(np.zeros((2, 2), np.float32)) == 0


def test_memories_that_cannot_work_are_refused() -> None:
    with pytest.raises(BadInput, match="working_least < working_most"):
        MemorySettings(working_most=5, working_least=5)


def save(folder: Path, weights: object, name: str = "XMem.pth") -> Path:
    torch.save(weights, folder / name)
    return folder


@pytest.fixture(scope="module")
def published() -> dict[str, torch.Tensor]:
    """Zeros with the published names and shapes."""
    return {name: torch.zeros(()).expand(shape) for name, shape in published_layers().items()}


def test_missing_weights_say_where_they_come_from_and_where_to_put_them(tmp_path: Path) -> None:
    said = r"XMem-s012.pth or XMem.pth \(about 249 MB\) of release v1.0 of the GitHub project hkchengrex/XMem"
    with pytest.raises(BadInput, match=f"--segmenter xmem needs learned weights.*{said}.*--weights DIR"):
        XMemSegmenter.from_weights(None)
    with pytest.raises(BadInput, match=f"no such folder; wanted: a folder that holds {said}"):
        load_network(tmp_path / "nowhere")
    (tmp_path / "other.pth").touch()
    with pytest.raises(BadInput, match=f"found other.pth in .*{said}. Put it there"):
        load_network(tmp_path)


def test_weights_that_are_no_checkpoint_are_refused(tmp_path: Path) -> None:
    (tmp_path / "XMem.pth").write_bytes(b"<html>not found</html>")
    with pytest.raises(BadInput, match="is no readable checkpoint.*Get it again"):
        load_network(tmp_path)
    save(tmp_path, [torch.zeros(2)])
    with pytest.raises(BadInput, match="holds no tensors by layer name"):
        load_network(tmp_path)


def test_weights_that_would_run_code_are_refused(tmp_path: Path) -> None:
    with open(tmp_path / "XMem.pth", "wb") as file:
        pickle.dump(Path("x"), file, protocol=2)  # an object of a class that is not a tensor
    with pytest.raises(BadInput, match="is no readable checkpoint"):
        load_network(tmp_path)


def test_weights_of_another_network_show_what_differs(tmp_path: Path, published: dict[str, torch.Tensor]) -> None:
    other = {name: layer for name, layer in published.items() if name != "decoder.pred.bias"}
    other["value_encoder.conv1.weight"] = torch.zeros(64, 4, 7, 7)
    other["aux.weight"] = torch.zeros(3)
    save(tmp_path, other)
    wanted = r"no decoder.pred.bias; unknown aux.weight; value_encoder.conv1.weight is \(64, 4, 7, 7\), wanted \(64, 5"
    with pytest.raises(BadInput, match=f"holds other layers: {wanted}"):
        load_network(tmp_path)


def test_a_file_of_the_published_layers_loads_with_or_without_counters(
    tmp_path: Path, published: dict[str, torch.Tensor]
) -> None:
    weights = published | {"decoder.pred.bias": torch.tensor([0.25])}
    save(tmp_path, {n: w for n, w in weights.items() if not n.endswith("num_batches_tracked")})
    network = load_network(tmp_path)
    assert not network.training
    assert network.decoder.pred.bias.tolist() == [0.25]
    save(tmp_path, weights)
    assert set(load_network(tmp_path).state_dict()) == set(published)
