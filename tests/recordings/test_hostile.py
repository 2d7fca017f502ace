"""Every reader on files made to exhaust a machine: below 1 GB and 10 s, and one message that says what was found.

Each runs in a process of its own, whose peak memory and processor time are what the system counted.
"""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from recordings.bounded.documents import parse_json
from recordings.bounded.limits import Budget, image_size, unpack
from recordings.errors import BadInput, DamagedFile
from recordings.importers.images import read_depth_png
from recordings.mcap.codec import decode_image, decode_mask
from recordings.records import EncodedImage

MOST_BYTES = 1 << 30
MOST_S = 10.0
SERVER = """
import gc, json, os, resource, sys, time
from pathlib import Path
import cv2, lz4.frame, numpy, rosbags.rosbag1, rosbags.rosbag2, rosbags.typesys, scipy.spatial.transform, trimesh, yaml
from recordings.errors import TosslabError
import recordings.importers.ros_bounds, recordings.importers.realsense, recordings.verify.verify
import recordings.mcap.recover
import recordings.importers.folder, recordings.importers.bundlesdf, recordings.importers.contactnets
import recordings.importers.rosbag, groundtruth.tagslam.detections, groundtruth.tagslam.yaml_pieces
import recordings.robot.collada, recordings.robot.arm

def attempt(imports, call, path):
    for limit, most in ((resource.RLIMIT_AS, 16 << 30), (resource.RLIMIT_CPU, 60)):
        resource.setrlimit(limit, (most, most))
    names = {"path": Path(path), "out": Path(path).parent / "out", "sys": sys}
    exec(imports, names)
    began = time.process_time()
    try:
        exec(call, names)
        end = "read"
    except TosslabError as wrong:
        end = " ".join(str(wrong).split())
    spent = time.process_time() - began
    peak = next(int(line.split()[1]) for line in open("/proc/self/status") if line.startswith("VmHWM"))
    return peak * 1024, spent, end

for line in sys.stdin:
    child = os.fork()
    if child == 0:
        try:
            print(json.dumps(attempt(*json.loads(line))), flush=True)
        except BaseException as wrong:
            print(json.dumps([0, 0, f"CRASHED: {type(wrong).__name__}: {str(wrong)[:300]}"]), flush=True)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    if status:
        print(json.dumps([0, 0, f"CRASHED with status {status}"]), flush=True)
"""
READERS = {
    "verify": ("from recordings.verify.verify import verify", "verify(path)"),
    "info": ("from recordings.verify.inspect import inspect", "inspect(path)"),
    "open": (
        "from recordings.session import Session",
        "toss = Session.open(path).toss(0); [toss.file.read('/d455/color', i) for i in range(3)]",
    ),
    "recover": ("from recordings.mcap.recover import recover_file", "recover_file(path, out)"),
    "mcap": (
        "from recordings.mcap.file import McapFile",
        "file = McapFile(path); [file.read('/d455/color', i) for i in range(3)]",
    ),
    "session": ("from recordings.session import Session", "Session.open(path.parent)"),
    "calibration": ("from recordings.tracks import RigCalibration", "RigCalibration.read(path)"),
    "folder": ("from recordings.importers.folder import import_folder", "import_folder(path, out)"),
    "folder of the file": ("from recordings.importers.folder import import_folder", "import_folder(path.parent, out)"),
    "bundlesdf": ("from recordings.importers.bundlesdf import import_bundlesdf", "import_bundlesdf([path], out)"),
    "contactnets": (
        "from recordings.importers.contactnets import import_contactnets",
        "import_contactnets(path, out, scale_m=1.0, dt_s=0.01)",
    ),
    "rosbag": ("from recordings.importers.rosbag import import_rosbag", "import_rosbag([path], out)"),
    "realsense": ("from recordings.importers.realsense import import_realsense", "import_realsense([path], out)"),
    "tagslam yaml": ("from groundtruth.tagslam.yaml_pieces import load", "load(path)"),
    "tagslam bag": ("from groundtruth.tagslam.detections import read_recording", "read_recording(path.parent)"),
    "truth folder": (
        "from recordings.importers.truth_folder import read_truth_folder",
        "read_truth_folder(path.parent.parent)",
    ),
    "tracks": ("from recordings.results.folder import read_track", "read_track(path.parent, 0)"),
    "hand": ("from recordings.results.folder import read_hand", "read_hand(path.parent, 0)"),
    "shape": ("from recordings.results.folder import read_shape", "read_shape(path.parent)"),
    "results": ("from recordings.results.folder import Results", "Results.open(path.parent.parent)"),
    "mesh": ("from recordings.bounded.mesh_file import load_mesh", "load_mesh(path)"),
    "urdf": ("from recordings.robot.arm import read_urdf", "read_urdf(path)"),
    "collada": ("from recordings.robot.collada import read_collada", "read_collada(path)"),
    "rig file": ("from acquisition.rig import read_rig", "read_rig(path)"),
    "static scene": (
        "from processing.segment.background.static_scene import StaticScene",
        "StaticScene.read(path.parent)",
    ),
    "rig of a session": ("from processing.segment.robot.of_session import Rig", "Rig.read(path.parent)"),
    "detection": ("from processing.segment.detect.detection import read_detection", "read_detection(path.parent, 0)"),
    "residuals": (
        "from processing.stages.judge import JudgeResult, residuals\nfrom processing.store import Done",
        "residuals(Done(path.parent, 'key', JudgeResult(None, None, None, 0, 0), True))",
    ),
    "weights": ("from processing.published_weights import XFEAT, read_weights", "read_weights(path, XFEAT)"),
}


def _load_hostile() -> ModuleType:
    spec = importlib.util.spec_from_file_location("hostile", Path(__file__).with_name("hostile.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


hostile = _load_hostile()


@dataclass(frozen=True)
class Outcome:
    """What a reader took and how it ended: `read`, or its message."""

    peak_bytes: int
    cpu_s: float
    end: str


class Apart:
    """Readers in processes forked from one that has imported them: each may take 16 GB and a minute."""

    def __init__(self) -> None:
        command = [sys.executable, "-c", SERVER]
        self.server = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

    def read(self, reader: str, path: Path) -> Outcome:
        """Raises AssertionError where the reader raised anything but one of our errors, or died."""
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        self.server.stdin.write(json.dumps([*READERS[reader], str(path)]) + "\n")
        self.server.stdin.flush()
        peak, cpu, end = json.loads(self.server.stdout.readline())
        assert not end.startswith("CRASHED"), end
        return Outcome(peak, cpu, end)

    def close(self) -> None:
        assert self.server.stdin is not None
        self.server.stdin.close()
        self.server.wait()


@pytest.fixture(scope="module")
def apart() -> Iterator[Apart]:
    opened = Apart()
    yield opened
    opened.close()


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Any, Path], None]:
    """Puts what a maker makes at a path: made once (a bomb of 1.2 GB takes long), and the same file where it recurs."""
    known: dict[Any, Path] = {}

    def put(make: Any, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        if make in known:
            os.link(known[make], path)
            return
        make(path)
        known[make] = tmp_path_factory.mktemp("hostile") / "made"
        os.link(path, known[make])

    return put


CASES = [
    # reader, file name, what is in it, what the message says ("" where it may be read)
    ("mcap", "toss_00.mcap", hostile.lying_lz4, "gave more than 64 bytes"),
    ("mcap", "toss_00.mcap", hostile.lying_zstd, "zstd data cannot be decompressed"),
    ("mcap", "toss_00.mcap", hostile.huge_chunk, "unpack to more than|declares 536870912"),
    ("info", "toss_00.mcap", hostile.honest_bombs, "unpack to more than"),
    ("recover", "toss_00.mcap", hostile.lying_lz4, ""),
    ("recover", "toss_00.mcap", hostile.honest_bombs, ""),
    ("recover", "toss_00.mcap", hostile.one_honest_bomb, ""),
    ("recover", "toss_00.mcap", hostile.decoys, ""),
    ("session", "session.json", hostile.nested_json, "nested deeper than 100 levels"),
    ("session", "session.json", hostile.nested_json_below_the_recursion_limit, "nested deeper than 100 levels"),
    ("session", "session.json", hostile.wide_json, "wanted a JSON object"),
    ("calibration", "calibration.json", hostile.nested_json, "nested deeper than 100 levels"),
    ("folder of the file", "session.json", hostile.nested_json, "nested deeper than 100 levels"),
    ("results", "variants/ours.all.json", hostile.nested_json, "nested deeper than 100 levels"),
    ("tagslam yaml", "tagslam.yaml", hostile.nested_yaml, "YAML file of 15000000 bytes"),
    ("tagslam yaml", "tagslam.yaml", hostile.nested_short_yaml, "nested deeper than 100 levels"),
    ("tagslam yaml", "tagslam.yaml", hostile.laughing_yaml, "aliases written out hold more than"),
    ("rosbag", "bag/metadata.yaml", hostile.laughing_yaml, "aliases written out hold more than"),
    ("tagslam bag", "tag_detections.bag.bz2", hostile.bz2_bomb, "unpack to more than"),
    ("tagslam bag", "tag_detections.bag", hostile.ros1_lz4, "chunk of more than"),
    ("tagslam bag", "detections.npz", hostile.npz_bomb, "unpack to 1258291328 bytes"),
    ("rosbag", "a.bag", hostile.ros1_bz2, "chunk of more than"),
    ("rosbag", "a.bag", hostile.ros1_lz4, "chunk of more than"),
    ("rosbag", "a.db3", hostile.db3_view, "computes its rows"),
    ("rosbag", "a.mcap", hostile.lying_lz4, "more than 64 bytes"),
    ("rosbag", "a.mcap", hostile.honest_bombs, "unpack to more than|more records than"),
    ("realsense", "a.db3", hostile.db3_view, "computes its rows"),
    ("realsense", "a.bag", hostile.realsense_lz4, "chunk of more than"),
    ("contactnets", "0.pt", hostile.pickle_of_lists, "no .pt file"),
    ("contactnets", "0.pt", hostile.expanded_tensor, "a tensor of 10000000000 numbers in a storage of 1"),
    ("truth folder", "toss_00/poses_camera_object.npz", hostile.npz_bomb, "unpack to 1258291328 bytes"),
    ("truth folder", "toss_00/poses_camera_object.npz", hostile.npz_promise, "promises an array of 17179869184 bytes"),
    ("tracks", "toss_00.track.npz", hostile.npz_bomb, "unpack to 1258291328 bytes"),
    ("tracks", "toss_00.track.npz", hostile.npz_promise, "promises an array of 17179869184 bytes"),
    ("static scene", "scene.npz", hostile.npz_promise, "promises an array of 17179869184 bytes"),
    ("static scene", "scene.npz", hostile.npz_bomb, "unpack to 1258291328 bytes"),
    ("residuals", "residuals.npz", hostile.npz_bomb, "unpack to 1258291328 bytes"),
    ("rig of a session", "rig.json", hostile.nested_json, "nested deeper than 100 levels"),
    ("rig of a session", "rig.json", hostile.json_of_nothing, "lacks 'camera_from_base'; remove its folder"),
    ("detection", "detections.json", hostile.nested_json, "nested deeper than 100 levels"),
    ("calibration", "calibration.json", hostile.three_gigabytes, "a JSON document of 3221225472 bytes"),
    ("session", "session.json", hostile.three_gigabytes, "a JSON document of 3221225472 bytes"),
    ("rig file", "lab.toml", hostile.three_gigabytes, "a rig file of 3221225472 bytes"),
    ("rig file", "lab.toml", hostile.nested_toml, "nested without end"),
    ("hand", "toss_00.hand.npy", hostile.npy_promise, "promises an array of 17179869184 bytes"),
    ("mesh", "mesh.obj", hostile.obj_crowd, ""),
    ("mesh", "mesh.obj", hostile.obj_with_image_bomb, ""),
    ("mesh", "mesh.ply", hostile.ply_promise, "cannot be read as a mesh"),
    ("urdf", "a.urdf", hostile.laughing_xml, "declares the document type"),
    ("urdf", "a.urdf", hostile.inflating_xml, "declares the document type"),
    ("urdf", "a.urdf", hostile.crowded_xml, "more than 100 levels or 100000 elements"),
    ("urdf", "a.urdf", hostile.deep_xml, "more than 100 levels or 100000 elements"),
    ("urdf", "a.urdf", hostile.urdf_backwards, "20000 joints; wanted at most 1000"),
    ("collada", "a.dae", hostile.laughing_xml, "declares the document type"),
    ("collada", "a.dae", hostile.repeating_collada, "its instances written out"),
    ("weights", "xfeat.pt", hostile.pickle_of_lists, "no readable checkpoint"),
    ("weights", "xfeat.pt", hostile.deflated_checkpoint, "its parts are compressed"),
    ("weights", "xfeat.pt", hostile.checkpoint_with_bytearray, "asks for builtins bytearray"),
]


@pytest.mark.parametrize(
    ("reader", "name", "make", "says"), CASES, ids=[f"{reader}-{make.__name__}" for reader, _, make, _ in CASES]
)
def test_a_hostile_file_of_15_mb_costs_below_1_gb_and_10_s_and_gives_one_message(
    reader: str, name: str, make: Any, says: str, tmp_path: Path, apart: Apart, made: Any, record_property: Any
) -> None:
    if reader == "realsense":
        pytest.importorskip("pyrealsense2")
    path = tmp_path / name
    made(make, path)
    assert min(path.stat().st_size, 512 * path.stat().st_blocks) <= hostile.MOST
    took = apart.read(reader, path.parent if name == "bag/metadata.yaml" else path)
    record_property("took", f"{took.peak_bytes / 1e6:.0f} MB, {took.cpu_s:.2f} s: {took.end[:200]}")
    assert took.peak_bytes < MOST_BYTES
    assert took.cpu_s < MOST_S
    assert re.search(says, took.end), took.end
    assert (took.end == "read") is (says == "")


BOMB = {"png of 20,000 x 20,000": (20_000, 20_000), "png as the calibration says": (5_700, 5_700)}


@pytest.mark.parametrize("size", BOMB.values(), ids=BOMB)
@pytest.mark.parametrize("layout", ["folder", "bundlesdf"])
def test_pictures_of_blanks_are_imported_or_refused_below_1_gb_and_10_s(
    layout: str, size: tuple[int, int], tmp_path: Path, apart: Apart
) -> None:
    image = hostile.png(*size, bits=16)
    recording = tmp_path / "recording"
    if layout == "folder":
        hostile.folder_layout(recording, image, *size)
    else:
        hostile.bundlesdf_layout(recording, image)
    took = apart.read(layout, recording)
    assert took.peak_bytes < MOST_BYTES
    assert took.cpu_s < MOST_S
    assert took.end != "read"


@pytest.mark.parametrize("size", [(20_000, 20_000), (5_700, 5_700)])
def test_verify_reads_the_header_of_a_picture_before_its_pixels(
    size: tuple[int, int], tmp_path: Path, small_rig: Any, apart: Apart
) -> None:
    """A whole session of bombs, its calibration saying their size: refused, or looked at within the limits."""
    from dataclasses import replace

    from recordings.session_writer import SessionWriter

    image = hostile.png(*size, colour=2, bits=8) if size[0] < 10_000 else hostile.png(*size)
    rig = replace(small_rig, width=size[0], height=size[1])
    with SessionWriter(tmp_path / "bombs", {"object": {"name": "cube"}}, rig.calibration) as session:
        with session.toss(0) as writer:
            for i in range(20):
                writer.color(EncodedImage("d455", i, i * 33_000_000, i * 33_000_000, "png", *size, image))
        session.finish()
    took = apart.read("verify", tmp_path / "bombs")
    assert took.peak_bytes < MOST_BYTES
    assert took.cpu_s < MOST_S


def test_an_image_of_another_size_than_the_calibrations_is_refused_by_its_header_alone():
    for data, kind in ((hostile.png(20_000, 20_000, whole=False), "png"), (hostile.jpeg(20_000, 20_000), "jpeg")):
        image = EncodedImage("d455", 7, 0, 0, kind, 640, 480, data)
        with pytest.raises(DamagedFile, match=r"d455 image 7: 20000x20000 pixels, the calibration says 640x480"):
            decode_image(image)


def test_a_picture_beyond_any_sensor_is_not_decoded_whatever_the_calibration_says():
    data = hostile.png(20_000, 20_000, whole=False)
    with pytest.raises(DamagedFile, match=r"its header declares 20000x20000 pixels; wanted at most 33554432"):
        decode_image(EncodedImage("d455", 7, 0, 0, "png", 20_000, 20_000, data))
    with pytest.raises(DamagedFile, match=r"masks/0.png: its header declares 20000x20000"):
        decode_mask(data, "masks/0.png")


def test_a_depth_picture_is_refused_by_its_header(tmp_path):
    path = tmp_path / "000000.png"
    path.write_bytes(hostile.png(20_000, 20_000, bits=16, whole=False))
    with pytest.raises(BadInput, match=r"000000.png: its header declares 20000x20000 pixels"):
        read_depth_png(path)


def test_the_size_of_a_picture_stands_in_its_header():
    assert image_size(hostile.png(17, 5)) == (17, 5)
    assert image_size(hostile.jpeg(1281, 720)) == (1281, 720)
    assert image_size(b"BM" + bytes(100)) is None  # OpenCV would decode a bitmap: whatever its size
    assert image_size(b"") is None


def test_a_chunk_unpacks_to_what_it_declares_and_not_a_byte_more():
    import lz4.frame

    packed = lz4.frame.compress(bytes(1000))
    assert unpack("lz4", packed, 1000) == bytes(1000)
    for wrong in (999, 1001):
        with pytest.raises(ValueError, match="a chunk gave"):
            unpack("lz4", packed, wrong)


def test_a_file_may_not_unpack_to_more_than_recordings_do():
    budget = Budget(1000)
    budget.take(1 << 28)
    with pytest.raises(ValueError, match="from a file of 1000 bytes"):
        budget.take(1 << 28)


def test_json_is_nested_as_deep_as_documents_are():
    assert parse_json(json.dumps([[1]]), "a") == [[1]]
    deep = "[" * 100 + "]" * 100
    assert parse_json(deep, "a") is not None
    with pytest.raises(DamagedFile, match="a is no readable JSON: it is nested deeper than 100 levels"):
        parse_json(f"[{deep}]", "a")


BETWEEN_PROCESSES = {  # lines of a process that we began, and a text that we wrote a line before
    "acquisition/drivers/franka_hand.py", "acquisition/drivers/realsense_parts.py",
    "acquisition/drivers/workers/arm.py", "acquisition/drivers/workers/franka.py",
    "acquisition/drivers/workers/process.py", "acquisition/drivers/workers/ur.py",
    "acquisition/simulators/child_process.py", "processing/evaluate/table.py",
}  # fmt: skip
LIMITED = {
    "acquisition/rig.py": "its bytes come through `limits.read_bytes`",
    "recordings/results/live.py": "a line of at most MOST_LINE_BYTES",
}
READERS_OF_ANYTHING = {("json", "load"), ("json", "loads"), ("np", "load"), ("tomllib", "load"), ("tomllib", "loads")}


def test_files_are_read_nowhere_but_through_the_bounded_readers() -> None:
    root, found = Path(__file__).resolve().parents[2], []
    for package in ("acquisition", "calibration", "groundtruth", "processing", "recordings"):
        for path in (root / package).rglob("*.py"):
            name = path.relative_to(root).as_posix()
            if name.startswith("recordings/bounded/") or name in BETWEEN_PROCESSES | LIMITED.keys():
                continue
            for node in ast.walk(ast.parse(path.read_text())):
                whose = node.value if isinstance(node, ast.Attribute) else None
                if isinstance(whose, ast.Name) and (whose.id, node.attr) in READERS_OF_ANYTHING:
                    found.append(f"{name}:{node.lineno}: {whose.id}.{node.attr}")
    assert not found
