"""Segmenters and matchers by name: what is chosen is made, what is missing is refused early."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from argparse import ArgumentParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from processing.backends import (
    MATCHERS,
    SEGMENTERS,
    Backends,
    add_arguments,
    check,
    chosen,
    make_matcher,
    make_segmenter,
    settings_of,
)
from processing.features.sift import FeatureMatcher
from processing.segment.background.segmenter import BackgroundSegmenter, BackgroundSettings
from processing.segment.background.static_scene import StaticScene
from processing.segment.segmenter import Segmenter
from processing.segment.xmem.checkpoint import published_layers
from recordings.errors import BadInput

FILES = {"xmem": "XMem-s012.pth", "loftr": "loftr_outdoor.ckpt", "xfeat": "xfeat.pt", "lightglue": "sift_lightglue.pth"}


@pytest.fixture(scope="module")
def background(tiny_world: Any) -> Segmenter:
    plane = np.zeros((120, 160), dtype=np.float32)
    scene = StaticScene(plane, plane, np.zeros((120, 160, 3), np.float32), plane, plane > 0, plane)
    return BackgroundSegmenter(scene, tiny_world.camera, BackgroundSettings())


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with files of the published names and layers, all zero."""
    kornia = pytest.importorskip("kornia.feature", reason="kornia is not installed: pip install -e .[learned]")
    from processing.features.lightglue import empty_network

    folder = tmp_path_factory.mktemp("weights")
    networks = {"loftr": kornia.LoFTR(None), "xfeat": kornia.XFeat().net, "lightglue": empty_network(kornia)}
    layers = {"xmem": published_layers()}
    layers |= {n: {k: tuple(v.shape) for k, v in net.state_dict().items()} for n, net in networks.items()}
    for name, shapes in layers.items():
        torch.save({k: torch.zeros(()).expand(s) for k, s in shapes.items()}, folder / FILES[name])
    return folder


def typed(*words: str) -> Backends:
    parser = ArgumentParser()
    add_arguments(parser)
    return chosen(parser.parse_args(words))


def test_by_default_nothing_is_needed(background: Segmenter) -> None:
    assert typed() == Backends("background", "sift", None)
    assert make_segmenter(Backends(), background) is background
    assert make_matcher(Backends()).name == "sift"
    assert settings_of("background", Backends()) == settings_of("sift", Backends()) == {}


def test_names_load_nothing_heavy() -> None:
    code = "import sys, processing.backends; print({'torch', 'cv2', 'kornia'} & set(sys.modules))"
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "set()"


@pytest.mark.parametrize("name", MATCHERS)
def test_every_matcher_is_made_by_its_name(name: str, weights: Path) -> None:
    made = make_matcher(typed("--matcher", name, "--weights", str(weights)))
    assert isinstance(made, FeatureMatcher)
    assert made.name == name


@pytest.mark.parametrize("name", SEGMENTERS)
def test_every_segmenter_is_made_by_its_name(name: str, weights: Path, background: Segmenter) -> None:
    made = make_segmenter(typed("--segmenter", name, "--weights", str(weights)), background)
    assert isinstance(made, Segmenter)
    assert made.name == name


def test_unknown_names_show_those_that_there_are() -> None:
    with pytest.raises(BadInput, match="no segmenter 'sam'; available: background, xmem"):
        typed("--segmenter", "sam")
    with pytest.raises(BadInput, match="no matcher 'orb'; available: sift, loftr, xfeat, lightglue"):
        typed("--matcher", "orb")


@pytest.mark.parametrize("name", FILES)
def test_missing_weights_are_refused_before_anything_is_read(name: str, tmp_path: Path) -> None:
    option = "--segmenter" if name in SEGMENTERS else "--matcher"
    with pytest.raises(BadInput, match=f"{option} {name} needs learned weights"):
        typed(option, name)
    with pytest.raises(BadInput, match=f"{option} {name}: found nothing in .*wanted: {FILES[name]}"):
        typed(option, name, "--weights", str(tmp_path))


def test_a_matcher_without_kornia_is_refused_early(weights: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("processing.backends.find_spec", lambda name: None)
    monkeypatch.setitem(sys.modules, "kornia.feature", None)
    with pytest.raises(BadInput, match=r"--matcher xfeat needs kornia.*pip install -e .\[learned\]"):
        check(Backends(matcher="xfeat", weights=weights))


def test_settings_tell_weights_by_content_and_not_by_place(tmp_path: Path) -> None:
    (tmp_path / "xfeat.pt").write_bytes(b"one")
    said = settings_of("xfeat", Backends(matcher="xfeat", weights=tmp_path))
    assert said == {"backend": "xfeat", "weights_sha256": hashlib.sha256(b"one").hexdigest()}
