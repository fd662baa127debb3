"""Serial ports: exclusive access, stable names, low latency, and errors that name the port, its owner and a remedy."""

from __future__ import annotations

import errno
import os
import termios
from contextlib import suppress
from pathlib import Path

import serial
import serial.tools.list_ports

from drivers.transport.fd_link import FdLink
from drivers.transport.link import LinkLost
from hal.errors import DeviceUnavailable

PTY_MAJORS = range(136, 144)  # Linux devices.txt
BITS_PER_BYTE = 10
USUAL_PORTS = ("ttyUSB*", "ttyACM*", "ttyAMA*")  # pyserial's scan of /sys would cost 1 ms per attempt
STABLE_NAMES = Path("/dev/serial/by-id")
SYSFS = Path("/sys/class/tty")
SHORT_TIMER_MS = 1  # shortest setting of an FTDI adapter; its default is 16


class SerialLink(FdLink):
    """Link over an open serial port."""

    def __init__(self, port: serial.Serial, *, path: str, baud: int) -> None:
        super().__init__(port.fileno(), f"serial {path}, {baud} baud")
        self._port = port
        self._path = path
        self._device_id = os.fstat(port.fileno()).st_rdev
        self.is_low_latency = _ask_for_low_latency(port)
        timer_ms = shorten_latency_timer(path)
        self.latency = "" if timer_ms is None else f", latency timer {timer_ms} ms"
        self._name += self.latency

    def is_present(self) -> bool:
        """Return whether the path still leads to the open character device; a re-plugged adapter is a different one."""
        try:
            return os.stat(self._path).st_rdev == self._device_id  # noqa: PTH116  # st_rdev of the symbolic link's target
        except OSError:
            return False

    @property
    def byte_s(self) -> float:
        """Return the duration of start bit, eight data bits and stop bit, in seconds; 0 for a pseudo terminal."""
        is_pseudo = os.major(self._device_id) in PTY_MAJORS
        return 0.0 if is_pseudo else BITS_PER_BYTE / float(self._port.baudrate)

    def set_baud(self, baud: int) -> None:
        """Change the baud rate of the open port."""
        try:
            self._port.baudrate = baud
        except (serial.SerialException, OSError, termios.error) as error:
            raise LinkLost(f"{self._name}: {error}") from error
        self._name = f"serial {self._path}, {baud} baud{self.latency}"

    def set_dtr(self, is_on: bool) -> None:
        """Set the DTR line; a pseudo terminal and some adapters have none, which is not an error."""
        with suppress(serial.SerialException, OSError):
            self._port.dtr = is_on

    def _release(self, fd: int) -> None:  # noqa: ARG002  # pyserial closes it
        try:
            self._port.close()
        except OSError as error:  # closing an unplugged port may fail
            if error.errno not in (errno.EIO, errno.EBADF, errno.ENODEV):
                raise


def open_serial(path: str, *, baud: int, device: str, parity: str = "N", stop_bits: int = 1) -> SerialLink:
    """Open a serial port for exclusive use by this process.

    Args:
        path: preferably a name that survives re-plugging, from `/dev/serial/by-id`.
        device: name of the device in the cell file, for errors.

    Raises:
        DeviceUnavailable: no such port, no permission, or another program holds it.
    """
    try:
        port = serial.Serial(path, baud, parity=parity, stopbits=stop_bits, timeout=0, write_timeout=0, exclusive=True)
    except (serial.SerialException, OSError, ValueError, termios.error) as error:  # termios.error is not an OSError
        raise _unavailable(path, device, error) from error
    return SerialLink(port, path=path, baud=baud)


def _ask_for_low_latency(port: serial.Serial) -> bool:
    """Request low latency, because FTDI adapters buffer for 16 ms otherwise (pyserial PR 290); return if it was accepted."""
    try:
        port.set_low_latency_mode(True)
    except (OSError, ValueError, NotImplementedError):
        return False
    return True


def latency_timer_ms(path: str, *, sysfs: Path = SYSFS) -> int | None:
    """Return how long the USB adapter behind `path` buffers bytes, in ms; None when its driver does not report it."""
    try:
        return int(_timer_file(path, sysfs).read_text())
    except (OSError, ValueError):
        return None


def shorten_latency_timer(path: str, *, sysfs: Path = SYSFS) -> int | None:
    """Set the adapter's latency timer to its minimum if permitted; return its value in ms, or None if it has none.

    Drivers that accept the low-latency request on an open port have done this already.
    """
    timer_ms = latency_timer_ms(path, sysfs=sysfs)
    if timer_ms is None or timer_ms <= SHORT_TIMER_MS:
        return timer_ms
    with suppress(OSError):
        _timer_file(path, sysfs).write_text(f"{SHORT_TIMER_MS}\n")
    return latency_timer_ms(path, sysfs=sysfs)


def _timer_file(path: str, sysfs: Path) -> Path:
    return sysfs / Path(os.path.realpath(path)).name / "device" / "latency_timer"


def _unavailable(path: str, device: str, error: Exception) -> DeviceUnavailable:
    what, hint = _diagnose(path, error)
    return DeviceUnavailable(f"{device}: {what}", hint=hint, device=device, link=path)


def _diagnose(path: str, error: Exception) -> tuple[str, str]:
    number = getattr(error, "errno", None)
    if number == errno.ENOENT or not Path(path).exists():
        return f"port {path} does not exist", f"plug the device in; ports now: {_ports_now()}"
    if number in (errno.EACCES, errno.EPERM):
        return f"no permission to open {path}", "add your user to the group that owns the port, usually `dialout`"
    if number in (errno.EBUSY, errno.EAGAIN) or "lock" in str(error).lower():
        owner = port_owner(path) or "another program"
        return f"port {path} is taken by {owner}", "close that program or choose another port"
    return f"port {path} cannot be opened: {error}", "check the port's name and that it is a serial port"


def _ports_now() -> str:
    ports = _stable_names() or sorted(str(p) for pattern in USUAL_PORTS for p in Path("/dev").glob(pattern))
    return ", ".join(ports) or "none"


def serial_ports() -> list[str]:
    """Return every serial port of this machine: by stable name, or as pyserial finds them where there are none."""
    return _stable_names() or sorted(port.device for port in serial.tools.list_ports.comports())


def _stable_names() -> list[str]:
    return sorted(str(path) for path in STABLE_NAMES.glob("*")) if STABLE_NAMES.is_dir() else []


def port_owner(path: str) -> str | None:
    """Return `name (pid N)` of a process that has `path` open, or None when none is visible."""
    try:
        wanted = os.path.realpath(path)
    except OSError:
        return None  # the process has ended meanwhile
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            if any(os.path.realpath(fd) == wanted for fd in folder.iterdir()):
                process = folder.parent
                return f"{(process / 'comm').read_text().strip()} (pid {process.name})"
        except OSError:
            continue
    return None
