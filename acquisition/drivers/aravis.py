"""The part of libaravis 0.8 (Debian: libaravis-0.8-0) that the GenICam driver uses, through ctypes.

Why ctypes and not `gi`: Debian's python3-gi belongs to the system's Python and to no other, so a virtual environment
of this project could use it only by sharing the system's packages, and only on one Python version. libaravis is plain
C with a stable interface; ctypes needs nothing else, and it gives up the interpreter's lock while a call waits.
"""

from __future__ import annotations

import ctypes
import threading
from collections.abc import Callable
from ctypes import POINTER, c_bool, c_char_p, c_double, c_int, c_int64, c_size_t, c_uint, c_uint64, c_void_p
from dataclasses import dataclass
from typing import Any

from acquisition.devices import DeviceRefused
from recordings.errors import DeviceNotFound

LIBRARY = "libaravis-0.8.so.0"
PACKAGE = "libaravis-0.8-0"
STATUS = {
    0: "success",
    1: "cleared",
    2: "timeout",
    3: "missing packets",
    4: "wrong packet id",
    5: "size mismatch",
    6: "filling",
    7: "aborted",
}


class AravisError(DeviceRefused):
    """What libaravis itself says went wrong."""


class _GError(ctypes.Structure):
    _fields_ = [("domain", ctypes.c_uint32), ("code", c_int), ("message", c_char_p)]


_LOST_CALLBACK = ctypes.CFUNCTYPE(None, c_void_p, c_void_p)
_ERROR = POINTER(POINTER(_GError))

# name -> (result, arguments); a last _ERROR argument is filled in by `_Library.call`
_FUNCTIONS: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_vendor": (c_char_p, (c_uint,)),
    "arv_get_device_model": (c_char_p, (c_uint,)),
    "arv_get_device_serial_nbr": (c_char_p, (c_uint,)),
    "arv_get_device_address": (c_char_p, (c_uint,)),
    "arv_get_device_protocol": (c_char_p, (c_uint,)),
    "arv_camera_new": (c_void_p, (c_char_p, _ERROR)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_get_vendor_name": (c_char_p, (c_void_p, _ERROR)),
    "arv_camera_get_model_name": (c_char_p, (c_void_p, _ERROR)),
    "arv_camera_get_device_serial_number": (c_char_p, (c_void_p, _ERROR)),
    "arv_camera_is_gv_device": (c_bool, (c_void_p,)),
    "arv_gv_device_is_controller": (c_bool, (c_void_p,)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int, _ERROR)),
    "arv_camera_gv_auto_packet_size": (c_uint, (c_void_p, _ERROR)),
    "arv_camera_is_feature_available": (c_bool, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_get_string": (c_char_p, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p, _ERROR)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int, _ERROR)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_set_frame_rate": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_frame_rate": (c_double, (c_void_p, _ERROR)),
    "arv_camera_get_frame_rate_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double), _ERROR)),
    "arv_camera_is_exposure_auto_available": (c_bool, (c_void_p, _ERROR)),
    "arv_camera_set_exposure_time_auto": (None, (c_void_p, c_int, _ERROR)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p, _ERROR)),
    "arv_camera_is_gain_auto_available": (c_bool, (c_void_p, _ERROR)),
    "arv_camera_set_gain_auto": (None, (c_void_p, c_int, _ERROR)),
    "arv_camera_set_gain": (None, (c_void_p, c_double, _ERROR)),
    "arv_camera_get_gain": (c_double, (c_void_p, _ERROR)),
    "arv_camera_set_trigger": (None, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_clear_triggers": (None, (c_void_p, _ERROR)),
    "arv_camera_software_trigger": (None, (c_void_p, _ERROR)),
    "arv_camera_set_chunks": (None, (c_void_p, c_char_p, _ERROR)),
    "arv_camera_create_chunk_parser": (c_void_p, (c_void_p,)),
    "arv_chunk_parser_get_integer_value": (c_int64, (c_void_p, c_void_p, c_char_p, _ERROR)),
    "arv_chunk_parser_get_float_value": (c_double, (c_void_p, c_void_p, c_char_p, _ERROR)),
    "arv_camera_get_payload": (c_uint, (c_void_p, _ERROR)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p, _ERROR)),
    "arv_camera_start_acquisition": (None, (c_void_p, _ERROR)),
    "arv_camera_stop_acquisition": (None, (c_void_p, _ERROR)),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
    "arv_stream_get_statistics": (None, (c_void_p, POINTER(c_uint64), POINTER(c_uint64), POINTER(c_uint64))),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_has_chunks": (c_bool, (c_void_p,)),
    "arv_buffer_get_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "g_object_unref": (None, (c_void_p,)),
    "g_clear_error": (None, (_ERROR,)),
    "g_signal_connect_data": (c_uint64, (c_void_p, c_char_p, _LOST_CALLBACK, c_void_p, c_void_p, c_int)),
}


@dataclass(frozen=True)
class Found:
    """A camera on the bus."""

    id: str
    vendor: str
    model: str
    serial: str
    address: str
    protocol: str

    def __str__(self) -> str:
        return f"{self.vendor} {self.model} serial {self.serial} ({self.protocol} at {self.address})"


class Aravis:
    """libaravis, loaded once. Raises DeviceNotFound where it is not installed."""

    _instance: Aravis | None = None
    _lock = threading.Lock()

    def __init__(self) -> None:
        try:
            self._library = ctypes.CDLL(LIBRARY)
        except OSError as missing:
            raise DeviceNotFound(
                f"the GenICam driver needs {LIBRARY}, which is not installed ({missing}); as root, run "
                f"`apt-get install -y --no-install-recommends {PACKAGE}`, or replay a session: "
                "`toss-record --rig replay:SESSION`"
            ) from missing
        for name, (result, arguments) in _FUNCTIONS.items():
            function = getattr(self._library, name)
            function.restype, function.argtypes = result, list(arguments)

    @classmethod
    def get(cls) -> Aravis:
        with cls._lock:
            if cls._instance is None:
                cls._instance = cls()
            return cls._instance

    def call(self, name: str, *arguments: Any) -> Any:
        """Call the function; a GError becomes AravisError. Strings go and come as str."""
        _, kinds = _FUNCTIONS[name]
        given = [argument.encode() if isinstance(argument, str) else argument for argument in arguments]
        function = getattr(self._library, name)
        if kinds and kinds[-1] is _ERROR:
            error = POINTER(_GError)()
            result = function(*given, ctypes.byref(error))
            if error:
                message = error.contents.message.decode(errors="replace")
                self._library.g_clear_error(ctypes.byref(error))
                raise AravisError(message)
        else:
            result = function(*given)
        return result.decode(errors="replace") if isinstance(result, bytes) else result

    def found(self) -> list[Found]:
        """The cameras that answer now, on every USB3 and network interface."""
        self.call("arv_update_device_list")
        keys = ("id", "vendor", "model", "serial_nbr", "address", "protocol")
        count = self.call("arv_get_n_devices")
        return [Found(*(self.call(f"arv_get_device_{key}", i) or "" for key in keys)) for i in range(count)]

    def controls(self, camera: int) -> bool:
        """Whether the camera obeys this process: a GigE camera obeys the first that opens it, as long as that lives."""
        if not self.call("arv_camera_is_gv_device", camera):
            return True
        return bool(self.call("arv_gv_device_is_controller", self.call("arv_camera_get_device", camera)))

    def on_lost(self, camera: int, act: Callable[[], None]) -> Any:
        """Call `act` (from a thread of libaravis) when the camera stops answering. Keep what this returns."""
        callback = _LOST_CALLBACK(lambda device, data: act())
        self.call(
            "g_signal_connect_data",
            self.call("arv_camera_get_device", camera),
            "control-lost",
            callback,
            None,
            None,
            0,
        )
        return callback
