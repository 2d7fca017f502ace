"""The GenICam description of our own GigE Vision camera: its features, and the registers behind them.

Written from the GenICam standard features naming convention; every register is big-endian.
"""

from __future__ import annotations

from collections.abc import Mapping

WIDTH, HEIGHT, OFFSET_X, OFFSET_Y = 0x10000, 0x10004, 0x10008, 0x1000C
PIXEL_FORMAT, PAYLOAD_SIZE = 0x10010, 0x10014
ACQUISITION, TRIGGER_SOFTWARE = 0x10020, 0x10024
TRIGGER_SELECTOR, TRIGGER_MODE, TRIGGER_SOURCE, TRIGGER_ACTIVATION = 0x10030, 0x10034, 0x10038, 0x1003C
LINE_SELECTOR, LINE_MODE, LINE_SOURCE = 0x10040, 0x10044, 0x10048
CHUNK_MODE, CHUNK_SELECTOR, CHUNK_ENABLE = 0x10050, 0x10054, 0x10058
LOCKED = 0x1005C
FRAME_RATE, EXPOSURE_US, GAIN = 0x10060, 0x10068, 0x10070
XML_ADDRESS = 0x20000

MONO8 = 0x01080001
SOFTWARE, LINE0 = 0, 1
CHUNK_IMAGE, CHUNK_TIMESTAMP, CHUNK_EXPOSURE, CHUNK_GAIN = 0x1, 0x2, 0x3, 0x4

_ENUMERATIONS: Mapping[str, tuple[int, Mapping[str, int]]] = {
    "PixelFormat": (PIXEL_FORMAT, {"Mono8": MONO8}),
    "TriggerSelector": (TRIGGER_SELECTOR, {"FrameStart": 0}),
    "TriggerMode": (TRIGGER_MODE, {"Off": 0, "On": 1}),
    "TriggerSource": (TRIGGER_SOURCE, {"Software": SOFTWARE, "Line0": LINE0}),
    "TriggerActivation": (TRIGGER_ACTIVATION, {"RisingEdge": 0}),
    "LineSelector": (LINE_SELECTOR, {"Line0": 0, "Line2": 2}),
    "LineMode": (LINE_MODE, {"Input": 0, "Output": 1}),
    "LineSource": (LINE_SOURCE, {"Off": 0, "ExposureActive": 1}),
    "ChunkSelector": (CHUNK_SELECTOR, {"Timestamp": 0, "ExposureTime": 1, "Gain": 2}),
}
_INTEGERS = {
    "Width": (WIDTH, 16, 4096),
    "Height": (HEIGHT, 16, 4096),
    "OffsetX": (OFFSET_X, 0, 4096),
    "OffsetY": (OFFSET_Y, 0, 4096),
    "PayloadSize": (PAYLOAD_SIZE, 0, 1 << 26),
    "TLParamsLocked": (LOCKED, 0, 1),
}
_FLOATS = {
    "AcquisitionFrameRate": (FRAME_RATE, 1.0, 200.0),
    "ExposureTime": (EXPOSURE_US, 10.0, 1e6),
    "Gain": (GAIN, 0.0, 48.0),
}
_BOOLEANS = {"ChunkModeActive": CHUNK_MODE, "ChunkEnable": CHUNK_ENABLE}
_COMMANDS = {
    "AcquisitionStart": (ACQUISITION, 1),
    "AcquisitionStop": (ACQUISITION, 0),
    "TriggerSoftware": (TRIGGER_SOFTWARE, 1),
}
_STRINGS = {"DeviceVendorName": (0x48, 32), "DeviceModelName": (0x68, 32), "DeviceVersion": (0x88, 32)}
_CHUNK_INTEGERS = {"ChunkTimestamp": CHUNK_TIMESTAMP}
_CHUNK_FLOATS = {"ChunkExposureTime": CHUNK_EXPOSURE, "ChunkGain": CHUNK_GAIN}


def description() -> bytes:
    """The whole document."""
    nodes = [
        *(_enumeration(name, *rest) for name, rest in _ENUMERATIONS.items()),
        *(_integer(name, *rest) for name, rest in _INTEGERS.items()),
        *(_float(name, *rest) for name, rest in _FLOATS.items()),
        *(_boolean(name, address) for name, address in _BOOLEANS.items()),
        *(_command(name, *rest) for name, rest in _COMMANDS.items()),
        *(_string(name, *rest) for name, rest in _STRINGS.items()),
        *(_chunk(name, chunk, "IntReg") for name, chunk in _CHUNK_INTEGERS.items()),
        *(_chunk(name, chunk, "FloatReg") for name, chunk in _CHUNK_FLOATS.items()),
        '<Port Name="Device"/>',
    ]
    named = [*_ENUMERATIONS, *_INTEGERS, *_FLOATS, *_BOOLEANS, *_COMMANDS, *_STRINGS, *_CHUNK_INTEGERS, *_CHUNK_FLOATS]
    features = "".join(f"<pFeature>{name}</pFeature>" for name in named)
    return (
        '<?xml version="1.0" encoding="utf-8"?>'
        '<RegisterDescription ModelName="SimCam" VendorName="tosslab" StandardNameSpace="None" '
        'SchemaMajorVersion="1" SchemaMinorVersion="1" SchemaSubMinorVersion="0" MajorVersion="1" MinorVersion="0" '
        'SubMinorVersion="0" ToolTip="simulated" ProductGuid="0" VersionGuid="0" '
        'xmlns="http://www.genicam.org/GenApi/Version_1_1">'
        f'<Category Name="Root" NameSpace="Standard">{features}</Category>{"".join(nodes)}</RegisterDescription>'
    ).encode()


def _register(name: str, address: int, kind: str = "IntReg", length: int = 4, access: str = "RW") -> str:
    sign = "<Sign>Unsigned</Sign>" if kind == "IntReg" else ""
    return (
        f'<{kind} Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length>'
        f"<AccessMode>{access}</AccessMode><pPort>Device</pPort>{sign}<Endianess>BigEndian</Endianess></{kind}>"
    )


def _enumeration(name: str, address: int, entries: Mapping[str, int]) -> str:
    listed = "".join(
        f'<EnumEntry Name="{entry}"><Value>{value}</Value></EnumEntry>' for entry, value in entries.items()
    )
    return f'<Enumeration Name="{name}">{listed}<pValue>{name}Reg</pValue></Enumeration>' + _register(
        f"{name}Reg", address
    )


def _integer(name: str, address: int, low: int, high: int) -> str:
    limits = f"<Min>{low}</Min><Max>{high}</Max>"
    return f'<Integer Name="{name}"><pValue>{name}Reg</pValue>{limits}</Integer>' + _register(f"{name}Reg", address)


def _float(name: str, address: int, low: float, high: float) -> str:
    limits = f"<Min>{low}</Min><Max>{high}</Max>"
    return f'<Float Name="{name}"><pValue>{name}Reg</pValue>{limits}</Float>' + _register(
        f"{name}Reg", address, "FloatReg", 8
    )


def _boolean(name: str, address: int) -> str:
    values = "<OnValue>1</OnValue><OffValue>0</OffValue>"
    return f'<Boolean Name="{name}"><pValue>{name}Reg</pValue>{values}</Boolean>' + _register(f"{name}Reg", address)


def _command(name: str, address: int, value: int) -> str:
    return (
        f'<Command Name="{name}"><pValue>{name}Reg</pValue><CommandValue>{value}</CommandValue></Command>'
        + _register(f"{name}Reg", address)
    )


def _string(name: str, address: int, length: int) -> str:
    return (
        f'<StringReg Name="{name}"><Address>{address:#x}</Address><Length>{length}</Length><AccessMode>RO</AccessMode>'
        "<pPort>Device</pPort></StringReg>"
    )


def _chunk(name: str, chunk: int, kind: str) -> str:
    sign = "<Sign>Unsigned</Sign>" if kind == "IntReg" else ""
    return (
        f'<{kind} Name="{name}"><Address>0x0</Address><Length>8</Length><AccessMode>RO</AccessMode>'
        f"<pPort>{name}Port</pPort>{sign}<Endianess>BigEndian</Endianess></{kind}>"
        f'<Port Name="{name}Port"><ChunkID>{chunk:x}</ChunkID></Port>'
    )
