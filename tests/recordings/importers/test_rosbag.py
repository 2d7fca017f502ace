"""ROS bags of both generations, written here with `rosbags`; bags without images are refused by naming their topics."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from recordings.errors import BadInput
from recordings.importers.rosbag import import_rosbag
from recordings.mcap.codec import decode_image
from recordings.session import Session

rosbags = pytest.importorskip("rosbags")
WIDTH, HEIGHT, FRAMES = 64, 48, 4
START_NS = 1_700_000_000_000_000_000
COLOR, DEPTH = "/camera/color/image_raw", "/camera/aligned_depth_to_color/image_raw"
KINDS = ["ros1.bag", "ros2_sqlite", "ros2_mcap"]


class BagMaker:
    """Writes one bag of a kind: `ros1.bag`, `ros2_sqlite` or `ros2_mcap` (folders)."""

    def __init__(self, path: Path) -> None:
        from rosbags.rosbag1 import Writer as Writer1
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.rosbag2 import Writer as Writer2
        from rosbags.typesys import Stores, get_typestore

        self.ros1 = path.suffix == ".bag"
        self.store = get_typestore(Stores.ROS1_NOETIC if self.ros1 else Stores.ROS2_HUMBLE)
        plugin = StoragePlugin.MCAP if "mcap" in path.name else StoragePlugin.SQLITE3
        self.writer: Any = Writer1(path) if self.ros1 else Writer2(path, version=9, storage_plugin=plugin)
        self.writer.open()
        self.connections: dict[str, Any] = {}

    def kind(self, name: str) -> Any:
        return self.store.types[name]

    def header(self, time_ns: int, frame: str = "camera_color_optical_frame", seq: int = 0) -> Any:
        stamp = self.kind("builtin_interfaces/msg/Time")(time_ns // 10**9, time_ns % 10**9)
        fields = {"stamp": stamp, "frame_id": frame, **({"seq": seq} if self.ros1 else {})}
        return self.kind("std_msgs/msg/Header")(**fields)

    def put(self, topic: str, name: str, message: Any, received_ns: int) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.store)
        data = self.store.serialize_ros1(message, name) if self.ros1 else self.store.serialize_cdr(message, name)
        self.writer.write(self.connections[topic], received_ns, data)

    def image(
        self, topic: str, pixels: np.ndarray, encoding: str, time_ns: int, pad: int = 0, seq: int = 0, late_ns: int = 0
    ) -> None:
        height, width = pixels.shape[:2]
        rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, pad)))
        name = "sensor_msgs/msg/Image"
        message = self.kind(name)(
            header=self.header(time_ns, seq=seq),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=rows.shape[1],
            data=rows.reshape(-1),
        )
        self.put(topic, name, message, time_ns + 20_000_000 + late_ns)

    def compressed(self, topic: str, data: bytes, form: str, time_ns: int) -> None:
        name = "sensor_msgs/msg/CompressedImage"
        message = self.kind(name)(self.header(time_ns), form, np.frombuffer(data, np.uint8))
        self.put(topic, name, message, time_ns + 20_000_000)

    def camera_info(
        self, topic: str, K: list[float], D: list[float], frame: str, size: tuple[int, int] = (WIDTH, HEIGHT)
    ) -> None:
        name = "sensor_msgs/msg/CameraInfo"
        roi = self.kind("sensor_msgs/msg/RegionOfInterest")(0, 0, 0, 0, False)
        upper = self.ros1
        numbers = {"D": np.array(D), "K": np.array(K), "R": np.eye(3).reshape(-1), "P": np.eye(3, 4).reshape(-1)}
        fields = numbers if upper else {k.lower(): v for k, v in numbers.items()}
        message = self.kind(name)(
            header=self.header(START_NS, frame),
            height=size[1],
            width=size[0],
            distortion_model="plumb_bob",
            binning_x=0,
            binning_y=0,
            roi=roi,
            **fields,
        )
        self.put(topic, name, message, START_NS)

    def joints(self, time_ns: int, names: list[str], position: np.ndarray, velocity: np.ndarray) -> None:
        name = "sensor_msgs/msg/JointState"
        message = self.kind(name)(self.header(time_ns), names, position, velocity, np.zeros(0))
        self.put("/joint_states", name, message, time_ns + 1_000_000)

    def static_transform(self, parent: str, child: str, xyz: tuple[float, float, float]) -> None:
        vector, quaternion = self.kind("geometry_msgs/msg/Vector3"), self.kind("geometry_msgs/msg/Quaternion")
        transform = self.kind("geometry_msgs/msg/Transform")(vector(*xyz), quaternion(0.0, 0.0, 0.0, 1.0))
        one = self.kind("geometry_msgs/msg/TransformStamped")(self.header(START_NS, parent), child, transform)
        self.put("/tf_static", "tf2_msgs/msg/TFMessage", self.kind("tf2_msgs/msg/TFMessage")([one]), START_NS)

    def text(self, topic: str) -> None:
        self.put(topic, "std_msgs/msg/String", self.kind("std_msgs/msg/String")("hello"), START_NS)


K = [60.0, 0.0, 31.0, 0.0, 61.0, 24.0, 0.0, 0.0, 1.0]
FINGERS_FIRST = ["panda_finger_joint1", "panda_finger_joint2", *(f"panda_joint{i}" for i in range(1, 8))]


def color_pixels(i: int) -> np.ndarray:
    return np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_pixels(i: int) -> np.ndarray:
    return np.random.default_rng(100 + i).integers(0, 3000, (HEIGHT, WIDTH)).astype(np.uint16)


MakeBag = Callable[..., Path]


@pytest.fixture
def make_bag(tmp_path: Path) -> MakeBag:
    """`make_bag("ros1.bag", fill)` writes a bag: `fill(maker)` says what is in it."""

    def make(kind: str, fill: Callable[[BagMaker], None]) -> Path:
        maker = BagMaker(tmp_path / kind)
        fill(maker)
        maker.writer.close()
        return tmp_path / kind

    return make


def usual(maker: BagMaker) -> None:
    """What a RealSense and a Panda publish: bgr8 with padded rows, aligned depth in mm, joints with fingers first."""
    maker.camera_info("/camera/color/camera_info", K, [0.1, -0.2, 0.001, 0.0, 0.05], "camera_color_optical_frame")
    for i in range(FRAMES):
        time_ns = START_NS + i * 33_333_333
        maker.image(COLOR, color_pixels(i)[..., ::-1], "bgr8", time_ns, pad=6, seq=50 + i)
        maker.image(DEPTH, depth_pixels(i), "16UC1", time_ns + 4_000_000, seq=70 + i)
        maker.image("/mono_left/image", color_pixels(i)[..., 0], "mono8", time_ns + 6_000_000)
        maker.joints(time_ns, FINGERS_FIRST, np.arange(9) * 0.01 + i, np.arange(9) * 0.1)
    maker.text("/chatter")


@pytest.mark.parametrize("kind", KINDS)
def test_the_usual_topics_come_in_to_the_last_bit(make_bag: MakeBag, tmp_path, kind):
    report = import_rosbag([make_bag(kind, usual)], tmp_path / "session")
    assert report.streams["/d455/color"] == report.streams["/d455/depth"] == report.streams["/mono0/image"] == FRAMES
    session = Session.open(tmp_path / "session")
    toss = session.toss(0)
    for i in range(FRAMES):
        np.testing.assert_array_equal(decode_image(toss.color()[i]), color_pixels(i))
        np.testing.assert_array_equal(toss.depth()[i].raw, depth_pixels(i))
        np.testing.assert_array_equal(decode_image(toss.mono("mono0")[i]), color_pixels(i)[..., 0])
    assert toss.color().times_ns.tolist() == [START_NS + i * 33_333_333 for i in range(FRAMES)]
    assert toss.color()[1].host_time_ns == toss.color()[1].time_ns + 20_000_000
    assert toss.depth()[0].unit_m == 0.001
    camera = session.calibration.camera("d455")
    assert (camera.fx, camera.cy, camera.distortion) == (60.0, 24.0, (0.1, -0.2, 0.001, 0.0, 0.05))
    assert toss.color()[2].index == (52 if kind == "ros1.bag" else 2)
    assert len(toss.rgbd()[0].depth_m) == HEIGHT


def test_joints_keep_their_order_and_the_fingers_become_a_width(make_bag: MakeBag, tmp_path):
    import_rosbag([make_bag("ros1.bag", usual)], tmp_path / "session")
    arm = Session.open(tmp_path / "session").toss(0).arm_states()
    assert arm is not None
    assert arm.joint_names == tuple(f"panda_joint{i}" for i in range(1, 8))
    np.testing.assert_allclose(arm.q_rad[1], np.arange(2, 9) * 0.01 + 1)
    np.testing.assert_allclose(arm.dq_rad_s[1], np.arange(2, 9) * 0.1)
    np.testing.assert_allclose(arm.finger_width_m, [2 * i + 0.01 for i in range(FRAMES)])


@pytest.mark.parametrize("kind", KINDS)
def test_compressed_images_keep_their_bytes(make_bag: MakeBag, tmp_path, kind):
    jpegs = [cv2.imencode(".jpg", color_pixels(i))[1].tobytes() for i in range(FRAMES)]

    def fill(maker: BagMaker) -> None:
        for i, jpeg in enumerate(jpegs):
            maker.compressed(f"{COLOR}/compressed", jpeg, "rgb8; jpeg compressed bgr8", START_NS + i * 10**8)
            png = b"\0" * 12 + cv2.imencode(".png", depth_pixels(i))[1].tobytes()
            maker.compressed(f"{DEPTH}/compressedDepth", png, "16UC1; compressedDepth png", START_NS + i * 10**8)

    report = import_rosbag([make_bag(kind, fill)], tmp_path / "session")
    toss = Session.open(tmp_path / "session").toss(0)
    assert [image.data for image in toss.color()] == jpegs
    np.testing.assert_array_equal(toss.depth()[2].raw, depth_pixels(2))
    assert any("no camera_info" in w for w in report.warnings)


def test_depth_in_float_metres_is_kept_to_a_quarter_of_a_millimetre(make_bag: MakeBag, tmp_path):
    depth_m = np.linspace(0, 4, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    depth_m[0, :3] = [np.nan, np.inf, -1]

    def fill(maker: BagMaker) -> None:
        maker.image(COLOR, color_pixels(0), "rgb8", START_NS)
        maker.image(DEPTH, depth_m, "32FC1", START_NS)

    report = import_rosbag([make_bag("ros2_mcap", fill)], tmp_path / "session")
    image = Session.open(tmp_path / "session").toss(0).depth()[0]
    assert image.raw[0, :3].tolist() == [0, 0, 0]
    np.testing.assert_allclose(image.raw[1:] * image.unit_m, depth_m[1:], atol=0.000126)
    assert any("0.25 mm" in w for w in report.warnings)


def test_a_raw_and_a_compressed_topic_of_one_camera_are_one_camera(make_bag: MakeBag, tmp_path):
    def fill(maker: BagMaker) -> None:
        maker.image(COLOR, color_pixels(0), "rgb8", START_NS)
        maker.compressed(f"{COLOR}/compressed", cv2.imencode(".jpg", color_pixels(0))[1].tobytes(), "jpeg", START_NS)

    import_rosbag([make_bag("ros1.bag", fill)], tmp_path / "session")
    np.testing.assert_array_equal(decode_image(Session.open(tmp_path / "session").toss(0).color()[0]), color_pixels(0))


def test_several_colour_cameras_must_be_told_apart(make_bag: MakeBag, tmp_path):
    def fill(maker: BagMaker) -> None:
        for side in ("left", "right"):
            maker.image(f"/{side}/image", color_pixels(len(side)), "rgb8", START_NS)

    bag = make_bag("ros1.bag", fill)
    with pytest.raises(BadInput, match="--color /left/image"):
        import_rosbag([bag], tmp_path / "session")
    import_rosbag([bag], tmp_path / "session", color="/right/image")
    np.testing.assert_array_equal(decode_image(Session.open(tmp_path / "session").toss(0).color()[0]), color_pixels(5))
    with pytest.raises(BadInput, match="has no images on /up/image"):
        import_rosbag([bag], tmp_path / "other", color="/up/image")


def unaligned(maker: BagMaker) -> None:
    maker.camera_info("/camera/color/camera_info", K, [], "color_optical")
    maker.camera_info("/camera/depth/camera_info", [50.0, 0, 40, 0, 50, 30, 0, 0, 1], [], "depth_optical", (80, 60))
    maker.image(COLOR, color_pixels(0), "rgb8", START_NS)
    maker.image("/camera/depth/image_rect_raw", np.full((60, 80), 800, np.uint16), "16UC1", START_NS)


def test_depth_that_is_not_aligned_comes_with_its_place_or_not_at_all(make_bag: MakeBag, tmp_path):
    with pytest.raises(BadInput, match="not aligned to colour, and /tf_static does not connect"):
        import_rosbag([make_bag("ros1.bag", unaligned)], tmp_path / "session")
    assert not (tmp_path / "session").exists()

    def fill(maker: BagMaker) -> None:
        unaligned(maker)
        maker.static_transform("camera_link", "color_optical", (0.0, 0.015, 0.0))
        maker.static_transform("camera_link", "depth_optical", (0.0, 0.0, 0.0))

    import_rosbag([make_bag("ros2_mcap", fill)], tmp_path / "session")
    session = Session.open(tmp_path / "session")
    place = session.calibration.transform("d455", "d455_depth")
    np.testing.assert_allclose(place.translation_m, [0, -0.015, 0])
    assert session.toss(0).rgbd()[0].depth_m[24, 32] == pytest.approx(0.8)


BAD_BAGS = {
    "yuv": (lambda m: m.image(COLOR, color_pixels(0)[..., :2], "yuv422_yuy2", START_NS), "'yuv422_yuy2'"),
    "cut off": (
        lambda m: m.put(
            COLOR,
            "sensor_msgs/msg/Image",
            m.kind("sensor_msgs/msg/Image")(m.header(START_NS), 48, 64, "rgb8", 0, 192, np.zeros(100, np.uint8)),
            START_NS,
        ),
        "it is cut off",
    ),
    "goes back": (
        lambda m: [m.image(COLOR, color_pixels(i), "rgb8", START_NS - i * 10**6, late_ns=i * 10**8) for i in range(2)],
        "goes back",
    ),
    "repeats": (lambda m: [m.image(COLOR, color_pixels(i), "rgb8", START_NS) for i in range(2)], "repeats"),
    "other size": (
        lambda m: [
            m.camera_info("/camera/color/camera_info", K, [], "c"),
            m.image(COLOR, color_pixels(0)[:24], "rgb8", START_NS),
        ],
        "its camera_info says 64x48",
    ),
    "size changes": (
        lambda m: [m.image(COLOR, color_pixels(i)[: 48 - i], "rgb8", START_NS + i) for i in range(2)],
        "after images of 64x48",
    ),
    "no images": (lambda m: m.text("/chatter"), "/chatter (std_msgs/msg/String)"),
}


@pytest.mark.parametrize("name", BAD_BAGS)
@pytest.mark.parametrize("kind", ["ros1.bag", "ros2_mcap"])
def test_a_bag_that_cannot_be_used_is_refused_and_leaves_nothing(make_bag: MakeBag, tmp_path, kind, name):
    fill, message = BAD_BAGS[name]
    with pytest.raises(BadInput) as refused:
        import_rosbag([make_bag(kind, fill)], tmp_path / "session")
    assert message in str(refused.value)
    assert not (tmp_path / "session").exists()


def test_images_without_stamps_take_the_times_of_reception(make_bag: MakeBag, tmp_path):
    def fill(maker: BagMaker) -> None:
        name = "sensor_msgs/msg/Image"
        for i in range(2):
            message = maker.kind(name)(maker.header(0), 48, 64, "rgb8", 0, 192, color_pixels(i).reshape(-1))
            maker.put(COLOR, name, message, START_NS + i * 10**8)

    report = import_rosbag([make_bag("ros1.bag", fill)], tmp_path / "session")
    assert Session.open(tmp_path / "session").toss(0).color().times_ns.tolist() == [START_NS, START_NS + 10**8]
    assert any("times of reception" in w for w in report.warnings)


def test_several_bags_are_several_tosses(make_bag: MakeBag, tmp_path):
    bags = [make_bag("ros1.bag", usual), make_bag("ros2_mcap", usual)]
    assert import_rosbag(bags, tmp_path / "session").tosses == (0, 1)


@pytest.mark.parametrize("kind", ["ros1.bag", "ros2_mcap"])
def test_a_truncated_bag_is_refused(make_bag: MakeBag, tmp_path, kind):
    bag = make_bag(kind, usual)
    file = bag if bag.is_file() else next(bag.glob("*.mcap"))
    whole = file.read_bytes()
    for end in (0, 7, 100, len(whole) // 2, len(whole) - 3):
        file.write_bytes(whole[:end])
        with pytest.raises(BadInput):
            import_rosbag([bag], tmp_path / "session")
        assert not (tmp_path / "session").exists()


def test_bags_of_ros_2_without_images_are_refused_by_naming_their_topics(data, tmp_path):
    root = data("rosbag2_mcap")
    files = sorted(root.rglob("*.mcap"))
    assert len(files) == 14
    for path in [*files, *{p.parent for p in files if (p.parent / "metadata.yaml").exists()}]:
        with pytest.raises(BadInput) as refused:
            import_rosbag([path], tmp_path / "session")
        wrong = "wrong_rmw" in str(path)
        assert ("wrong_format" if wrong else "holds no images") in str(refused.value)
        assert not (tmp_path / "session").exists()
