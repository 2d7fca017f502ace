"""One tensor out of a .pt file, without torch and without executing anything.

torch.save writes a pickle that names where the numbers lie. Here its opcodes are walked (`pickletools.genops` only
reads) and nothing is accepted but what a plain tensor needs: numbers, text, tuples, lists, dicts, the storage types,
and the calls `torch._utils._rebuild_tensor_v2` and `collections.OrderedDict`, which are recognised by name and never
imported. Both containers are read: the zip archive of torch 1.6 and later, and the older chain of pickles.
"""

from __future__ import annotations

import io
import math
import pickletools
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy import ndarray as Array

from recordings.bounded.limits import MOST_TENSOR_STEPS
from recordings.errors import BadInput
from recordings.importers.common import read_bytes

STORAGES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
REBUILD = ("torch._utils", "_rebuild_tensor_v2")
LEGACY_MAGIC = 0x1950A86A20F9469CFC6C
LEGACY_PROTOCOL = 1001
_MARK = object()
_SILENT = {"PROTO", "FRAME"}
_PUSH = {"BININT", "BININT1", "BININT2", "LONG1", "BINUNICODE", "SHORT_BINUNICODE", "BINFLOAT"}
_CONSTANTS: dict[str, Any] = {"NEWFALSE": False, "NEWTRUE": True, "NONE": None, "EMPTY_TUPLE": ()}
_SHORT_TUPLES = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_PUT, _GET = {"BINPUT", "LONG_BINPUT", "PUT"}, {"BINGET", "LONG_BINGET", "GET"}


class _Refused(Exception):
    """The pickle asks for something that a plain tensor does not need."""


_MALFORMED = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, EOFError, struct.error)
_RAISED = (_Refused, zipfile.BadZipFile, NotImplementedError, *_MALFORMED)


@dataclass(frozen=True)
class _Global:
    module: str
    name: str


@dataclass(frozen=True)
class _Storage:
    dtype: str
    key: str
    count: int


@dataclass(frozen=True)
class _Tensor:
    storage: _Storage
    offset: int
    shape: tuple[int, ...]
    stride: tuple[int, ...]


def read_tensor(path: Path) -> Array:
    """The tensor that `torch.save(tensor, path)` wrote. Raises BadInput for anything else, saying what it found."""
    data = read_bytes(path)
    try:
        return _read_zip(data) if data.startswith(b"PK") else _read_legacy(data)
    except _RAISED as wrong:
        raise BadInput(f"{path} is no .pt file that holds one plain tensor ({wrong})") from wrong


def _read_zip(data: bytes) -> Array:
    archive = zipfile.ZipFile(io.BytesIO(data))
    names = archive.namelist()
    if any(entry.compress_type != zipfile.ZIP_STORED or entry.flag_bits & 1 for entry in archive.infolist()):
        raise _Refused("a compressed or encrypted archive, which torch.save never writes")
    if sum(entry.file_size for entry in archive.infolist()) > len(data):
        raise _Refused("its entries lie over one another")
    if archive.testzip() is not None:
        raise _Refused("a checksum in it differs: the file is damaged")
    pickles = [n for n in names if n == "data.pkl" or n.endswith("/data.pkl")]
    if len(pickles) != 1:
        raise _Refused(f"a zip archive with {len(pickles)} data.pkl")
    root = pickles[0][: -len("data.pkl")]
    if f"{root}byteorder" in names and archive.read(f"{root}byteorder") != b"little":
        raise _Refused("its byte order is not little")
    tensor = _walk(io.BytesIO(archive.read(pickles[0])))
    return _build(tensor, lambda storage: archive.read(f"{root}data/{storage.key}"))


def _read_legacy(data: bytes) -> Array:
    stream = io.BytesIO(data)
    if _walk(stream) != LEGACY_MAGIC or _walk(stream) != LEGACY_PROTOCOL:
        raise _Refused("it does not begin as torch.save begins")
    system = _walk(stream)
    if not isinstance(system, dict) or system.get("little_endian") is not True:
        raise _Refused("its byte order is not little")
    tensor = _walk(stream)
    keys = _walk(stream)

    def storage_bytes(wanted: _Storage) -> bytes:
        if keys != [wanted.key]:
            raise _Refused(f"storages {keys}; wanted the one of the tensor")
        (count,) = struct.unpack("<q", stream.read(8))
        if count != wanted.count:
            raise _Refused(f"a storage of {count} numbers where {wanted.count} were promised")
        return stream.read(count * np.dtype(wanted.dtype).itemsize)

    return _build(tensor, storage_bytes)


def _build(tensor: Any, read: Callable[[_Storage], bytes]) -> Array:
    if not isinstance(tensor, _Tensor):
        raise _Refused(f"it holds {type(tensor).__name__}, not a tensor")
    raw = read(tensor.storage)
    dtype = np.dtype(tensor.storage.dtype)
    if len(raw) != tensor.storage.count * dtype.itemsize:
        raise _Refused(f"{len(raw)} bytes for {tensor.storage.count} numbers: the file was cut off")
    numbers = np.frombuffer(raw, dtype=dtype)
    if min((*tensor.shape, *tensor.stride, tensor.offset), default=0) < 0:
        raise _Refused("a negative size")
    if 0 in tensor.shape:
        return np.zeros(tensor.shape, dtype=dtype)
    last = tensor.offset + sum((n - 1) * s for n, s in zip(tensor.shape, tensor.stride, strict=True))
    if last >= len(numbers):
        raise _Refused("the tensor reaches beyond its storage")
    if math.prod(tensor.shape) > len(numbers):
        raise _Refused(f"a tensor of {math.prod(tensor.shape)} numbers in a storage of {len(numbers)}")
    strides = tuple(s * dtype.itemsize for s in tensor.stride)
    view = np.lib.stride_tricks.as_strided(numbers[tensor.offset :], tensor.shape, strides, writeable=False)
    return np.array(view)


def _walk(stream: io.BytesIO) -> Any:
    """Walk one pickle of the stream and return what it describes: plain values, _Storage or _Tensor."""
    stack: list[Any] = []
    memo: dict[int, Any] = {}
    for step, (opcode, argument, _) in enumerate(pickletools.genops(stream)):
        name = opcode.name
        if step > MOST_TENSOR_STEPS:
            raise _Refused(f"its pickle has more than {MOST_TENSOR_STEPS} steps")
        if name == "STOP":
            if len(stack) != 1:
                raise _Refused("its pickle does not end in one value")
            return stack[0]
        if name in _PUT:
            memo[_number(argument)] = stack[-1]
        elif name == "MEMOIZE":
            memo[len(memo)] = stack[-1]
        elif name in _GET:
            stack.append(memo[_number(argument)])
        elif name not in _SILENT:
            _step(name, argument, stack)
    raise _Refused("its pickle has no end")


def _number(argument: Any) -> int:
    return int(argument)


def _step(name: str, argument: Any, stack: list[Any]) -> None:
    if name in _PUSH:
        stack.append(argument)
    elif name in _CONSTANTS:
        stack.append(_CONSTANTS[name])
    elif name in _SHORT_TUPLES:
        stack.append(tuple(_pop(stack, _SHORT_TUPLES[name])))
    elif name == "MARK":
        stack.append(_MARK)
    elif name == "TUPLE":
        stack.append(tuple(_pop_to_mark(stack)))
    elif name in ("EMPTY_DICT", "EMPTY_LIST"):
        stack.append({} if name == "EMPTY_DICT" else [])
    elif name in ("APPENDS", "APPEND"):
        items = _pop_to_mark(stack) if name == "APPENDS" else _pop(stack, 1)
        _top(stack, list).extend(items)
    elif name in ("SETITEMS", "SETITEM"):
        items = _pop_to_mark(stack) if name == "SETITEMS" else _pop(stack, 2)
        _top(stack, dict).update(zip(items[::2], items[1::2], strict=True))
    elif name == "GLOBAL":
        stack.append(_global(*argument.split(" ", 1)))
    elif name == "STACK_GLOBAL":
        stack.append(_global(*_pop(stack, 2)))
    elif name == "BINPERSID":
        stack.append(_storage(stack.pop()))
    elif name == "REDUCE":
        function, arguments = _pop(stack, 2)
        stack.append(_call(function, arguments))
    else:
        raise _Refused(f"its pickle uses {name}, which a plain tensor does not need")


def _pop(stack: list[Any], count: int) -> list[Any]:
    taken = stack[-count:]
    if len(taken) != count or any(item is _MARK for item in taken):
        raise _Refused("its pickle is malformed")
    del stack[-count:]
    return taken


def _pop_to_mark(stack: list[Any]) -> list[Any]:
    for at in range(len(stack) - 1, -1, -1):
        if stack[at] is _MARK:
            taken = stack[at + 1 :]
            del stack[at:]
            return taken
    raise _Refused("its pickle is malformed")


def _top(stack: list[Any], kind: type) -> Any:
    if not isinstance(stack[-1], kind):
        raise _Refused("its pickle is malformed")
    return stack[-1]


def _global(module: str, name: str) -> _Global:
    if (module, name) in (REBUILD, ("collections", "OrderedDict")) or (module == "torch" and name in STORAGES):
        return _Global(module, name)
    raise _Refused(f"it asks for {module}.{name}; wanted one plain tensor")


def _storage(identity: Any) -> _Storage:
    kind, storage, key, _, count, *view = identity
    known = isinstance(storage, _Global) and storage.name in STORAGES and isinstance(count, int)
    if kind != "storage" or not known or not isinstance(key, str) or any(v is not None for v in view):
        raise _Refused("its storage is of an unknown kind")
    if "/" in key or not 0 <= count <= 1 << 32:
        raise _Refused("its storage is of an unknown kind")
    return _Storage(STORAGES[storage.name], key, count)


def _call(function: Any, arguments: Any) -> Any:
    if not isinstance(function, _Global) or not isinstance(arguments, tuple):
        raise _Refused("its pickle is malformed")
    if function.name == "OrderedDict" and arguments == ():
        return {}
    if (function.module, function.name) == REBUILD and isinstance(arguments[0], _Storage):
        storage, offset, shape, stride = arguments[:4]
        return _Tensor(storage, int(offset), tuple(map(int, shape)), tuple(map(int, stride)))
    raise _Refused(f"it calls {function.module}.{function.name}")
