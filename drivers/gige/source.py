"""Opens a GenICam camera, with bounded waiting when it does not answer."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
import struct
from typing import Protocol

from drivers.gige.aravis import AravisCamera, AravisError, cameras_found
from drivers.gige.frames import Frame
from drivers.gige.settings import US, GigeCameraOptions, exposure_of, read_back, write
from drivers.kinds.cameras import release_in_background
from drivers.transport.link import LinkLost, NoAnswer, now_s
from hal.camera_settings import CameraSettings
from hal.errors import ConfigError, DeviceUnavailable

BUFFERS = 8
CONTROL_PORT = 3956
DISCOVERY = struct.pack(">BBHHH", 0x42, 0x11, 0x0002, 0, 1)  # key, acknowledge and broadcast reply, command, length, id
DISCOVERY_ANSWER = 0x0003
PROBE_S = 0.1
POLITE_S = 0.4  # a camera that answers is given back in 1 ms; one that does not, in 5 s


class FrameSource(Protocol):
    """An open camera that sends frames, as the driver uses it."""

    width_px: int
    height_px: int
    settings: CameraSettings

    def pop(self, timeout_s: float) -> Frame | None:
        """Return the next frame, complete or not, or None when none came in time."""
        ...

    def trigger(self) -> None:
        """Start one exposure."""
        ...

    def exposure_s(self) -> float | None:
        """Ask the camera for its present exposure time."""
        ...

    def set_exposure(self, exposure_s: float) -> None:
        """Set the exposure time of the frames that begin after this call."""
        ...

    def check(self) -> None:
        """Check that the camera still answers and obeys this program.

        Raises:
            LinkLost, NoAnswer: it does not.
        """
        ...

    def close(self) -> None:
        """Release the camera, in bounded time."""
        ...


class GenicamSource:
    """Open camera with the options written, streaming.

    Raises:
        DeviceUnavailable: there is no such camera, or it refuses a value. NoAnswer: it is silent.
    """

    def __init__(self, options: GigeCameraOptions, device: str, address: str | None) -> None:
        self._address = address
        if address is not None:
            probe(address)
        try:
            self._camera = AravisCamera(address or options.camera)
        except AravisError as error:
            raise DeviceUnavailable(
                f"{device}: camera {options.camera!r} cannot be opened: {error}",
                hint=f"check power and cable; these cameras answer: {', '.join(cameras_found()) or 'none'}",
                device=device,
            ) from error
        try:
            self._begin(options, device)
        except BaseException:
            self.close()
            raise

    def _begin(self, options: GigeCameraOptions, device: str) -> None:
        if not self._camera.is_controller():
            raise NoAnswer("another program controls the camera, or did until 3 s ago")
        try:
            write(self._camera, options)
            self.settings = read_back(self._camera, options)
            _, _, self.width_px, self.height_px = self._camera.region()
            self._camera.start(buffers=BUFFERS, socket_buffer_bytes=options.socket_buffer_bytes)
        except AravisError as error:
            raise ConfigError(
                f"{device}: camera {options.camera!r} refuses its settings: {error}",
                hint=f"correct devices.{device}.options: the camera's data sheet has its ranges",
            ) from error

    def pop(self, timeout_s: float) -> Frame | None:
        """Return the next frame, or None when none came in time."""
        return self._camera.pop(timeout_s)

    def trigger(self) -> None:
        """Start one exposure."""
        self._ask("software_trigger")

    def exposure_s(self) -> float | None:
        """Ask the camera for its present exposure time."""
        try:
            return exposure_of(self._camera)
        except AravisError as error:
            raise NoAnswer(str(error)) from error

    def set_exposure(self, exposure_s: float) -> None:
        """Set the exposure time of the frames that begin after this call."""
        self._ask("set_exposure_time", exposure_s * US)

    def check(self) -> None:
        """Check that the camera still answers and obeys this program."""
        if not self._camera.is_controller():
            raise LinkLost("the control of the camera was lost: it restarted, or another program took it")
        if self._address is not None:
            probe(self._address)

    def close(self) -> None:
        """Stop and release the camera; one that does not answer is released by a thread in the background."""
        release_in_background(self._release, POLITE_S)

    def _release(self) -> None:
        with contextlib.suppress(AravisError):
            self._camera.stop()
        self._camera.release()

    def _ask(self, command: str, *values: float) -> None:
        try:
            self._camera.do(command, *values)
        except AravisError as error:
            raise NoAnswer(str(error)) from error


def probe(address: str) -> None:
    """Ask a GigE Vision camera whether it is there, which takes Aravis 2.5 s when it is not.

    Raises:
        LinkLost: the network reports that nothing is there. NoAnswer: silence.
    """
    until_s = now_s() + PROBE_S
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asker:
        try:
            asker.connect((address, CONTROL_PORT))
            asker.send(DISCOVERY)
            while (left_s := until_s - now_s()) > 0.0:
                asker.settimeout(left_s)
                answer = asker.recv(1024)
                if len(answer) >= 8 and struct.unpack(">H", answer[2:4])[0] == DISCOVERY_ANSWER:
                    return
        except TimeoutError:
            pass
        except OSError as error:
            raise LinkLost(f"no camera at {address}: {error.strerror}") from error
    raise NoAnswer(f"the camera at {address} does not answer")


def address_of(camera: str) -> str | None:
    """Return the IP address of a camera that is named by it, by its id or by its serial number; None for USB cameras.

    Every other name is left to the library.
    """
    with contextlib.suppress(ValueError):
        return str(ipaddress.ip_address(camera))
    for name, address in cameras_found().items():
        if name == camera:
            with contextlib.suppress(ValueError):
                return str(ipaddress.ip_address(address))
    return None
