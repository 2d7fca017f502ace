"""Files that ask for more than they are: bombs, promises, nests, multiplied entities. Each at most 15 MB."""

from __future__ import annotations

import bz2
import hashlib
import io
import json
import os
import sqlite3
import struct
import zipfile
import zlib
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard

MOST = 15_000_000
MAGIC = b"\x89MCAP0\r\n"


def png(width: int, height: int, *, whole: bool = True, bits: int = 8, colour: int = 0) -> bytes:
    """A grey PNG of zeros; where not `whole`, its pixels are missing."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    packer = zlib.compressobj(9)
    row = bytes(1 + width * bits // 8)
    pixels = b"".join(packer.compress(row) for _ in range(height if whole else 1)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")


def jpeg(width: int, height: int) -> bytes:
    """A JPEG that ends behind its frame header."""
    frame = struct.pack(">BHHB", 8, height, width, 3) + bytes([1, 17, 0, 2, 17, 1, 3, 17, 1])
    return b"\xff\xd8\xff\xc0" + struct.pack(">H", len(frame) + 2) + frame + b"\xff\xd9"


def three_gigabytes(path: Path) -> None:
    """A file that the disk holds as a hole."""
    path.touch()
    os.truncate(path, 3 << 30)


def json_of_nothing(path: Path) -> None:
    path.write_text("{}")


def nested_toml(path: Path) -> None:
    path.write_text("a = " + 100_000 * "[")


def nested_json(path: Path) -> None:
    path.write_bytes(b"[" * (MOST // 2) + b"]" * (MOST // 2))


def nested_json_below_the_recursion_limit(path: Path) -> None:
    path.write_text('{"format_version": 1, "start": ' + '{"a":' * 900 + "1" + "}" * 900 + "}")


def wide_json(path: Path) -> None:
    path.write_bytes(b'{"format_version": 1, "start": [' + b"{}," * (MOST // 3 - 20) + b"{}]}")


def nested_yaml(path: Path) -> None:
    path.write_bytes(b"a: " + b"[" * (MOST - 3))


def nested_short_yaml(path: Path) -> None:
    path.write_bytes(b"a: " + b"[" * 900 + b"]" * 900)


def laughing_yaml(path: Path) -> None:
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{i}: &a{i} [" + ", ".join([f"*a{i - 1}"] * 10) + "]" for i in range(1, 12)]
    path.write_text("\n".join(rows))


def laughing_xml(path: Path) -> None:
    entities = '<!ENTITY a0 "ha">' + "".join(f'<!ENTITY a{i} "{f"&a{i - 1};" * 10}">' for i in range(1, 10))
    path.write_text(f"<!DOCTYPE robot [{entities}]><robot><link name='&a9;'/></robot>")


def inflating_xml(path: Path) -> None:
    """One long entity, named often: below the amplification that expat itself refuses."""
    path.write_text(f"<!DOCTYPE r [<!ENTITY a '{'x' * 300_000}'>]><r>" + "&a;" * 90 * 20 + " " * 14_000_000 + "</r>")


def crowded_xml(path: Path) -> None:
    path.write_bytes(b"<robot>" + b"<a/>" * (MOST // 4 - 8) + b"</robot>")


def deep_xml(path: Path) -> None:
    path.write_bytes(b"<a>" * (MOST // 7) + b"</a>" * (MOST // 7))


def urdf_backwards(path: Path) -> None:
    """A chain of joints, the last one first: putting them in order costs the square of their number."""
    rows = [
        f'<joint name="j{i}" type="fixed"><parent link="l{i}"/><child link="l{i + 1}"/></joint>' for i in range(20_000)
    ]
    path.write_text("<robot name='r'>" + "".join(reversed(rows)) + "<link name='l0'/></robot>")


def repeating_collada(path: Path) -> None:
    """One geometry, placed thirty thousand times."""
    points = "0.1 " * 600_000
    node = '<node><instance_geometry url="#g"/></node>'
    path.write_text(
        '<COLLADA><asset><up_axis>Z_UP</up_axis></asset><geometry id="g"><mesh><source id="s"><float_array>'
        f'{points}</float_array></source><vertices id="v"><input semantic="POSITION" source="#s"/></vertices>'
        '<triangles><input semantic="VERTEX" source="#v" offset="0"/><p>0 1 2</p></triangles></mesh></geometry>'
        f"{node * 30_000}"
        "</COLLADA>"
    )


def npz_bomb(path: Path) -> None:
    """Deflated zeros: 1 MB that unpack to 1.2 GB."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (1200 << 17,)})
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive, archive.open("t.npy", "w") as file:
        file.write(head.getvalue())
        for _ in range(1200):
            file.write(bytes(1 << 20))


def npz_promise(path: Path) -> None:
    """An array's header that promises sixteen gigabytes and holds nothing."""
    head = io.BytesIO()
    np.lib.format.write_array_header_1_0(head, {"descr": "<f8", "fortran_order": False, "shape": (1 << 31,)})
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("t", "topics", "toss", "status_names"):
            archive.writestr(f"{name}.npy", head.getvalue())


def npy_promise(path: Path) -> None:
    with open(path, "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (1 << 31,)})


def pickle_of_lists(path: Path) -> None:
    path.write_bytes(b"\x80\x02" + b"]" * (MOST - 3) + b".")


def expanded_tensor(path: Path) -> None:
    """One number that is said to be a tensor of 100,000 x 100,000, every stride 0."""
    torch = __import__("torch")
    torch.save(torch.zeros(1).expand(100_000, 100_000), path)


def deflated_checkpoint(path: Path) -> None:
    """A checkpoint whose numbers are deflated: 1 MB that unpack to 1.2 GB."""
    import torch

    plain = path.with_suffix(".plain")
    torch.save({"layer": torch.zeros(4)}, plain)
    with zipfile.ZipFile(plain) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.infolist():
            if not entry.filename.endswith("data/0"):
                new.writestr(entry.filename, old.read(entry))
                continue
            with new.open(entry.filename, "w", force_zip64=True) as file:
                for _ in range(1200):
                    file.write(bytes(1 << 20))


def checkpoint_with_bytearray(path: Path) -> None:
    """Its pickle asks for a bytearray of eight gigabytes, which torch's careful unpickler allows."""
    path.write_bytes(b"PK")
    body = b"\x80\x02cbuiltins\nbytearray\n\x8a\x08" + struct.pack("<q", 8 << 30) + b"\x85R."
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("archive/data.pkl", body)
        archive.writestr("archive/version", "3\n")


def bz2_bomb(path: Path) -> None:
    """Zeros: half a megabyte that unpacks to ten gigabytes."""
    packed = bz2.compress(bytes(10 << 20))
    path.write_bytes(packed * 1000)


def obj_crowd(path: Path) -> None:
    path.write_bytes(b"v 0 0 0\n" * 600_000 + b"f 1 2 3\n" * 1_200_000)


def obj_with_image_bomb(path: Path) -> None:
    """A mesh whose material names a picture of 15,000 x 15,000 beside it."""
    (path.parent / "bomb.png").write_bytes(png(15_000, 15_000))
    (path.parent / "bomb.mtl").write_text("newmtl a\nmap_Kd bomb.png\n")
    path.write_text("mtllib bomb.mtl\nusemtl a\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n")


def ply_promise(path: Path) -> None:
    path.write_bytes(
        b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty double x\nproperty double y\n"
        b"property double z\nelement face 2000000000\nproperty list uchar int vertex_indices\nend_header\n"
    )


def db3_view(path: Path, name: str = "/device_0/sensor_0/Depth_0/image/data") -> None:
    """A recording whose messages are a view that never ends."""
    with sqlite3.connect(path) as database:
        database.execute("create table topics(id integer, name text, type text, serialization_format text)")
        database.execute("insert into topics values (1, ?, 'sensor_msgs/msg/Image', 'cdr')", (name,))
        database.execute(
            "create view messages as with recursive n(id) as (select 1 union all select id + 1 from n) "
            "select id, 1 as topic_id, id as timestamp, zeroblob(100000) as data from n"
        )
    database.close()


def _record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def mcap(path: Path, packed: list[tuple[str, int, bytes]], schema: str = "sensor_msgs/msg/Image") -> None:
    """An indexed MCAP file of these chunks: (compression, declared size, bytes)."""
    definitions = _record(3, struct.pack("<H", 1) + _text(schema) + _text("ros2msg") + _text("uint8 a"))
    definitions += _record(4, struct.pack("<HH", 1, 1) + _text("/d455/color") + _text("cdr") + struct.pack("<I", 0))
    out = io.BytesIO()
    out.write(MAGIC + _record(1, _text("ros2") + _text("hostile")) + definitions)
    places = []
    for compression, size, data in packed:
        chunk = _record(
            6, struct.pack("<QQQI", 1, 2, size, 0) + _text(compression) + struct.pack("<Q", len(data)) + data
        )
        index = _record(7, struct.pack("<HI", 1, 16) + struct.pack("<QQ", 1, 0))
        offsets = struct.pack("<I", 10) + struct.pack("<HQ", 1, out.tell() + len(chunk))
        places.append(
            struct.pack("<QQQQ", 1, 2, out.tell(), len(chunk))
            + offsets
            + struct.pack("<Q", len(index))
            + _text(compression)
            + struct.pack("<QQ", len(data), size)
        )
        out.write(chunk + index)
    out.write(_record(15, struct.pack("<I", 0)))
    start = out.tell()
    n = len(packed)
    out.write(definitions + b"".join(_record(8, place) for place in places))
    counts = struct.pack("<I", 10) + struct.pack("<HQ", 1, n)
    out.write(_record(11, struct.pack("<QHIIIIQQ", n, 1, 1, 0, 0, n, 1, 2) + counts))
    out.write(_record(2, struct.pack("<QQI", start, 0, 0)) + MAGIC)
    path.write_bytes(out.getvalue())


def lying_lz4(path: Path) -> None:
    """A chunk that declares 64 bytes and unpacks to more than a gigabyte."""
    mcap(path, [("lz4", 64, _lz4_zeros(1200 << 20))])


def lying_zstd(path: Path) -> None:
    """A zstd frame that does not say its size; the chunk declares 64 bytes, more than a gigabyte come out."""
    packer = zstandard.ZstdCompressor(write_content_size=False).compressobj()
    data = b"".join(packer.compress(bytes(1 << 24)) for _ in range(75)) + packer.flush()
    mcap(path, [("zstd", 64, data)])


def honest_bombs(path: Path) -> None:
    """Two hundred chunks that declare what they hold: 100 MiB of empty records each."""
    raw = _record(0x80, b"") * ((100 << 20) // 9)
    data = zstandard.ZstdCompressor().compress(raw)
    mcap(path, [("zstd", len(raw), data)] * min(200, MOST // len(data)))


def one_honest_bomb(path: Path) -> None:
    raw = _record(0x80, b"") * ((100 << 20) // 9)
    mcap(path, [("zstd", len(raw), zstandard.ZstdCompressor().compress(raw))])


def huge_chunk(path: Path) -> None:
    mcap(path, [("lz4", 1 << 29, _lz4_zeros(1 << 29))])


def decoys(path: Path) -> None:
    """Every nine bytes begin what might be an attachment as long as the rest of the file."""
    count = (MOST - 8) // 9
    path.write_bytes(MAGIC + b"".join(struct.pack("<BQ", 9, (count - i) * 9 - 9) for i in range(count)))


def _lz4_zeros(size: int) -> bytes:
    packer = lz4.frame.LZ4FrameCompressor(block_size=lz4.frame.BLOCKSIZE_MAX4MB)
    block = bytes(1 << 24)
    parts = [packer.begin()] + [packer.compress(block) for _ in range(size >> 24)]
    return b"".join([*parts, packer.flush()])


def _ros1_record(fields: dict[str, bytes], data: bytes) -> bytes:
    head = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in fields.items())
    return struct.pack("<I", len(head)) + head + struct.pack("<I", len(data)) + data


def ros1_bag(path: Path, compression: str, packed: bytes, declared: int, topic: str = "/camera/image") -> None:
    """A bag of ROS 1 with one chunk, its index naming one message at the chunk's start."""
    about = {
        "topic": topic.encode(),
        "type": b"sensor_msgs/Image",
        "md5sum": hashlib.md5(b"uint8 a").hexdigest().encode(),
    }
    about["message_definition"] = b"uint8 a"
    content = b"".join(struct.pack("<I", len(k) + 1 + len(v)) + k.encode() + b"=" + v for k, v in about.items())
    connection = _ros1_record({"op": b"\x07", "conn": bytes(4), "topic": topic.encode()}, content)
    head = 13 + 4096
    chunk = _ros1_record(
        {"op": b"\x05", "compression": compression.encode(), "size": struct.pack("<I", declared)}, packed
    )
    entry = struct.pack("<III", 1, 0, 0)
    index = _ros1_record(
        {"op": b"\x04", "ver": struct.pack("<I", 1), "conn": bytes(4), "count": struct.pack("<I", 1)}, entry
    )
    info = {"op": b"\x06", "ver": struct.pack("<I", 1), "chunk_pos": struct.pack("<Q", head)}
    info |= {
        "start_time": struct.pack("<II", 1, 0),
        "end_time": struct.pack("<II", 1, 0),
        "count": struct.pack("<I", 1),
    }
    infos = connection + _ros1_record(info, struct.pack("<II", 0, 1))
    fields = {"op": b"\x03", "index_pos": struct.pack("<Q", head + len(chunk) + len(index))}
    fields |= {"conn_count": struct.pack("<I", 1), "chunk_count": struct.pack("<I", 1)}
    bare = _ros1_record(fields, b"")
    first = _ros1_record(fields, b" " * (4096 - len(bare)))
    path.write_bytes(b"#ROSBAG V2.0\n" + first + chunk + index + infos)


def ros1_bz2(path: Path) -> None:
    ros1_bag(path, "bz2", bz2.compress(bytes(200 << 20)), 64)


def ros1_lz4(path: Path) -> None:
    ros1_bag(path, "lz4", _lz4_zeros(1200 << 20), 64)


def realsense_lz4(path: Path) -> None:
    ros1_bag(path, "lz4", _lz4_zeros(1200 << 20), 64, "/device_0/sensor_0/Depth_0/image/data")


def camera_of(width: int, height: int) -> dict[str, object]:
    K = [[width, 0, width / 2], [0, width, height / 2], [0, 0, 1]]
    return {"K": K, "width": width, "height": height, "distortion": [], "depth_unit_m": 0.001}


def folder_layout(path: Path, image: bytes, width: int, height: int, suffix: str = "png") -> None:
    """A recording of the folder layout whose images are all these bytes."""
    for name in ("rgb", "depth"):
        (path / "toss_00" / name).mkdir(parents=True)
    for i in range(max(1, min(8, MOST // 2 // max(1, len(image))))):
        (path / "toss_00" / "rgb" / f"{i:06d}.{suffix}").write_bytes(image)
        (path / "toss_00" / "depth" / f"{i:06d}.png").write_bytes(image)
        with open(path / "toss_00" / "timestamps.txt", "a") as times:
            times.write(f"{i / 30:.6f}\n")
    (path / "session.json").write_text(json.dumps({"object": "a", "camera": camera_of(width, height)}))


def bundlesdf_layout(path: Path, image: bytes) -> None:
    for name in ("rgb", "depth", "masks"):
        (path / name).mkdir(parents=True)
        (path / name / "000000.png").write_bytes(image)
    (path / "cam_K.txt").write_text("600 0 320 0 600 240 0 0 1")
