"""Calls the Aravis library (GigE Vision, USB3 Vision) through ctypes; one thread at a time uses a camera.

Aravis is a C library of the distribution (`libaravis-0.8-0` in Debian), so nothing is compiled and no binding package is
installed. ctypes releases the interpreter's lock during every call.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import socket
import threading
import time
from contextlib import suppress
from ctypes import POINTER, byref, c_bool, c_char_p, c_double, c_int, c_size_t, c_uint, c_uint32, c_uint64, c_void_p
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from drivers.gige.frames import COMPLETE, STATUS, Frame
from hal.errors import ConfigError

LIBRARY = "aravis-0.8"
PACKET_SOCKET_DISABLED = 1
SOCKET_BUFFER_FIXED = 0
RETENTION_US = (
    200_000  # a frame whose packets pause for longer is incomplete; the library's 100 ms is short on a busy machine
)
_opening = threading.Lock()  # the library's list of devices is global


class AravisError(Exception):
    """A call to the library failed; the text is that of the library."""


class _GError(ctypes.Structure):
    _fields_ = (("domain", c_uint32), ("code", c_int), ("message", c_char_p))


_Failure = POINTER(POINTER(_GError))
_SIGNATURES: dict[str, tuple[Any, tuple[Any, ...]]] = {
    "arv_update_device_list": (None, ()),
    "arv_get_n_devices": (c_uint, ()),
    "arv_get_device_id": (c_char_p, (c_uint,)),
    "arv_get_device_address": (c_char_p, (c_uint,)),
    "arv_camera_new": (c_void_p, (c_char_p, _Failure)),
    "arv_camera_get_device": (c_void_p, (c_void_p,)),
    "arv_camera_is_gv_device": (c_bool, (c_void_p,)),
    "arv_camera_get_region": (None, (c_void_p, *(POINTER(c_int),) * 4, _Failure)),
    "arv_camera_set_region": (None, (c_void_p, c_int, c_int, c_int, c_int, _Failure)),
    "arv_camera_get_payload": (c_uint, (c_void_p, _Failure)),
    "arv_camera_create_stream": (c_void_p, (c_void_p, c_void_p, c_void_p, _Failure)),
    "arv_camera_start_acquisition": (None, (c_void_p, _Failure)),
    "arv_camera_stop_acquisition": (None, (c_void_p, _Failure)),
    "arv_camera_set_acquisition_mode": (None, (c_void_p, c_int, _Failure)),
    "arv_camera_clear_triggers": (None, (c_void_p, _Failure)),
    "arv_camera_set_trigger": (None, (c_void_p, c_char_p, _Failure)),
    "arv_camera_software_trigger": (None, (c_void_p, _Failure)),
    "arv_camera_set_frame_rate": (None, (c_void_p, c_double, _Failure)),
    "arv_camera_get_exposure_time": (c_double, (c_void_p, _Failure)),
    "arv_camera_get_exposure_time_bounds": (None, (c_void_p, POINTER(c_double), POINTER(c_double), _Failure)),
    "arv_camera_get_exposure_time_auto": (c_int, (c_void_p, _Failure)),
    "arv_camera_set_exposure_time": (None, (c_void_p, c_double, _Failure)),
    "arv_camera_set_exposure_time_auto": (None, (c_void_p, c_int, _Failure)),
    "arv_camera_is_exposure_time_available": (c_bool, (c_void_p, _Failure)),
    "arv_camera_is_exposure_auto_available": (c_bool, (c_void_p, _Failure)),
    "arv_camera_get_gain": (c_double, (c_void_p, _Failure)),
    "arv_camera_set_gain": (None, (c_void_p, c_double, _Failure)),
    "arv_camera_set_gain_auto": (None, (c_void_p, c_int, _Failure)),
    "arv_camera_is_gain_available": (c_bool, (c_void_p, _Failure)),
    "arv_camera_is_gain_auto_available": (c_bool, (c_void_p, _Failure)),
    "arv_camera_get_pixel_format_as_string": (c_char_p, (c_void_p, _Failure)),
    "arv_camera_set_pixel_format_from_string": (None, (c_void_p, c_char_p, _Failure)),
    "arv_camera_is_feature_available": (c_bool, (c_void_p, c_char_p, _Failure)),
    "arv_camera_set_string": (None, (c_void_p, c_char_p, c_char_p, _Failure)),
    "arv_camera_get_float": (c_double, (c_void_p, c_char_p, _Failure)),
    "arv_camera_set_float": (None, (c_void_p, c_char_p, c_double, _Failure)),
    "arv_camera_set_integer": (None, (c_void_p, c_char_p, ctypes.c_int64, _Failure)),
    "arv_camera_set_boolean": (None, (c_void_p, c_char_p, c_bool, _Failure)),
    "arv_camera_gv_auto_packet_size": (c_uint, (c_void_p, _Failure)),
    "arv_camera_gv_set_packet_size": (None, (c_void_p, c_int, _Failure)),
    "arv_camera_gv_set_packet_delay": (None, (c_void_p, ctypes.c_int64, _Failure)),
    "arv_camera_gv_set_stream_options": (None, (c_void_p, c_int)),
    "arv_gv_device_is_controller": (c_bool, (c_void_p,)),
    "arv_gv_stream_get_port": (ctypes.c_uint16, (c_void_p,)),
    "arv_buffer_new_allocate": (c_void_p, (c_size_t,)),
    "arv_buffer_get_status": (c_int, (c_void_p,)),
    "arv_buffer_get_frame_id": (c_uint64, (c_void_p,)),
    "arv_buffer_get_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_system_timestamp": (c_uint64, (c_void_p,)),
    "arv_buffer_get_image_width": (c_int, (c_void_p,)),
    "arv_buffer_get_image_height": (c_int, (c_void_p,)),
    "arv_buffer_get_image_pixel_format": (c_uint32, (c_void_p,)),
    "arv_buffer_get_image_data": (c_void_p, (c_void_p, POINTER(c_size_t))),
    "arv_stream_push_buffer": (None, (c_void_p, c_void_p)),
    "arv_stream_timeout_pop_buffer": (c_void_p, (c_void_p, c_uint64)),
}


class _Library:
    """The library's functions, with their types; a failure that it reports becomes an `AravisError`."""

    def __init__(self, path: str) -> None:
        self._functions = ctypes.CDLL(path)
        for name, (result, arguments) in _SIGNATURES.items():
            function = getattr(self._functions, name)
            function.restype, function.argtypes = result, arguments
        self.objects = ctypes.CDLL(ctypes.util.find_library("gobject-2.0"))
        self.objects.g_object_unref.argtypes = (c_void_p,)
        self.objects.g_object_unref.restype = None
        self._glib = ctypes.CDLL(ctypes.util.find_library("glib-2.0"))
        self._glib.g_error_free.argtypes = (POINTER(_GError),)
        self._glib.g_error_free.restype = None

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function that reports failures in its last argument, which is added here."""
        failure = POINTER(_GError)()
        result = getattr(self._functions, name)(*arguments, byref(failure))
        if failure:
            text = failure.contents.message.decode(errors="replace")
            self._glib.g_error_free(failure)
            raise AravisError(text)
        return result

    def plain(self, name: str, *arguments: Any) -> Any:
        """Call a function that reports no failures."""
        return getattr(self._functions, name)(*arguments)

    def unref(self, pointer: int) -> None:
        """Give an object back."""
        self.objects.g_object_unref(pointer)


@cache
def library() -> _Library:
    """Load the library once.

    Raises:
        ConfigError: it is not installed.
    """
    path = ctypes.util.find_library(LIBRARY)
    if path is None:
        raise ConfigError(
            "the library Aravis, which speaks to GigE Vision and USB3 Vision cameras, is not installed",
            hint="install it: `apt-get install libaravis-0.8-0` on Debian and Ubuntu, `dnf install aravis` on Fedora",
        )
    return _Library(path)


def cameras_found() -> dict[str, str]:
    """Return the ids of all cameras that answer a search of about one second, with their addresses."""
    lib = library()
    with _opening:
        lib.plain("arv_update_device_list")
        indices = range(lib.plain("arv_get_n_devices"))
        return {
            lib.plain("arv_get_device_id", i).decode(): (lib.plain("arv_get_device_address", i) or b"").decode()
            for i in indices
        }


class AravisCamera:
    """An open camera and, after `start`, its stream.

    Args:
        name: id, serial number or IP address.

    Raises:
        AravisError: no such camera, or it does not answer.
    """

    def __init__(self, name: str) -> None:
        self._lib = library()
        self._stream: int | None = None
        with _opening:
            self._camera: int = self._lib.call("arv_camera_new", name.encode())
        if not self._camera:
            raise AravisError(f"no camera {name!r} was found")
        self._device = self._lib.plain("arv_camera_get_device", self._camera)
        self.is_network = bool(self._lib.plain("arv_camera_is_gv_device", self._camera))

    def do(self, function: str, *arguments: Any) -> Any:
        """Call `arv_camera_FUNCTION` of this camera; text is converted both ways.

        Raises:
            AravisError: the camera refused, or did not answer.
        """
        raw = (a.encode() if isinstance(a, str) else a for a in arguments)
        result = self._lib.call(f"arv_camera_{function}", self._camera, *raw)
        return result.decode() if isinstance(result, bytes) else result

    def has(self, feature: str) -> bool:
        """Return whether the camera has a GenICam feature."""
        return bool(self.do("is_feature_available", feature))

    def region(self) -> tuple[int, int, int, int]:
        """Return offsets, width and height of the region that is sent, in pixels."""
        numbers = [c_int() for _ in range(4)]
        self.do("get_region", *(byref(n) for n in numbers))
        x, y, width, height = (n.value for n in numbers)
        return x, y, width, height

    def exposure_bounds_us(self) -> tuple[float, float]:
        """Return the least and the longest exposure in microseconds."""
        least, longest = c_double(), c_double()
        self.do("get_exposure_time_bounds", byref(least), byref(longest))
        return least.value, longest.value

    def disable_packet_socket(self) -> None:
        """Receive through an ordinary socket; a packet socket sees one network interface only and needs privileges."""
        self._lib.plain("arv_camera_gv_set_stream_options", self._camera, PACKET_SOCKET_DISABLED)

    def start(self, *, buffers: int, socket_buffer_bytes: int) -> None:
        """Start the stream; the system limits the size of the socket's buffer (`net.core.rmem_max`)."""
        payload = self.do("get_payload")
        self._stream = self._lib.call("arv_camera_create_stream", self._camera, None, None)
        if self.is_network:
            self._set_property("socket-buffer", SOCKET_BUFFER_FIXED)
            self._set_property("socket-buffer-size", socket_buffer_bytes)
            self._set_property("frame-retention", RETENTION_US)
            _enlarge_receive_buffer(self._lib.plain("arv_gv_stream_get_port", self._stream), socket_buffer_bytes)
        for _ in range(buffers):
            self._lib.plain("arv_stream_push_buffer", self._stream, self._lib.plain("arv_buffer_new_allocate", payload))
        self.do("start_acquisition")

    def pop(self, timeout_s: float) -> Frame | None:
        """Wait for the next frame, complete or not, and return a copy; None if there is none in time."""
        lib = self._lib
        buffer = lib.plain("arv_stream_timeout_pop_buffer", self._stream, max(0, round(timeout_s * 1e6)))
        if not buffer:
            return None
        try:
            return self._copy(buffer)
        finally:
            lib.plain("arv_stream_push_buffer", self._stream, buffer)

    def is_controller(self) -> bool:
        """Return whether this program still controls the camera, as far as the last heartbeat told."""
        return not self.is_network or bool(self._lib.plain("arv_gv_device_is_controller", self._device))

    def stop(self) -> None:
        """Stop the stream of a camera that answers."""
        self.do("stop_acquisition")

    def release(self) -> None:
        """Give stream and camera back; this takes seconds when the camera does not answer."""
        if self._stream is not None:
            self._lib.unref(self._stream)
            self._stream = None
        if self._camera:
            self._lib.unref(self._camera)
            self._camera = 0

    def _copy(self, buffer: int) -> Frame:
        get, size = self._lib.plain, c_size_t()
        status = get("arv_buffer_get_status", buffer)
        fault = None if status == COMPLETE else STATUS.get(status, f"status {status}")
        stamp_ns = get("arv_buffer_get_timestamp", buffer)
        data = np.empty(0, np.uint8)
        if fault is None:
            start = get("arv_buffer_get_image_data", buffer, byref(size))
            data = np.frombuffer(ctypes.string_at(start, size.value), np.uint8)
        return Frame(
            fault=fault,
            frame_id=get("arv_buffer_get_frame_id", buffer),
            device_s=stamp_ns * 1e-9 if stamp_ns else None,
            arrived_s=_on_links_clock(get("arv_buffer_get_system_timestamp", buffer) * 1e-9),
            width_px=get("arv_buffer_get_image_width", buffer) if fault is None else 0,
            height_px=get("arv_buffer_get_image_height", buffer) if fault is None else 0,
            pixel_format=get("arv_buffer_get_image_pixel_format", buffer) if fault is None else 0,
            data=data,
        )

    def _set_property(self, name: str, value: int) -> None:
        self._lib.objects.g_object_set(c_void_p(self._stream), name.encode(), c_int(value), c_void_p(None))


def _enlarge_receive_buffer(port: int, size_bytes: int) -> None:
    """Enlarge the receive buffer of this process's UDP socket at a port, where the system lists open files (Linux).

    Aravis sizes its socket only when the first packet of a frame is there. Until then the buffer has the system's default
    of 208 KiB, which one frame of 512x512 pixels overfills: about one first frame in four was incomplete on a busy machine.
    """
    with suppress(FileNotFoundError):
        for opened in Path("/proc/self/fd").iterdir():
            with suppress(OSError):  # closed since it was listed
                if not opened.readlink().name.startswith("socket:"):
                    continue
                with socket.socket(fileno=os.dup(int(opened.name))) as copy:
                    if copy.type == socket.SOCK_DGRAM and copy.getsockname()[1] == port:
                        copy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, size_bytes)


def _on_links_clock(utc_s: float) -> float:
    """Return a time of the system's UTC clock on the clock of `time.monotonic`, never later than now."""
    here_s = time.monotonic()
    return min(here_s, here_s - (time.time() - utc_s))
