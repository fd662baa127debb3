"""Wrong devices, wrong ids and vanishing ports raise typed errors that name the device, the port and the remedy."""

import random
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from typing import Any

import pytest

from drivers.emulators import ft300, modbus_io, robotiq_2f, rplidar, scripted, tfmini
from drivers.emulators.ports import FarPort, PtyPort, TcpPort
from drivers.kinds.arms import kinematics_of
from drivers.ur import rtde
from hal.errors import CellError, ConfigError, DeviceUnavailable
from hal.registry import Context, connect
from tests.drivers.rigs import soon, wired


def refusal(name: str, driver: str, options: dict[str, Any]) -> DeviceUnavailable:
    """Return the error of a connection that must fail."""
    with pytest.raises(DeviceUnavailable) as caught:
        connect(Context(name=name), driver, options)
    return caught.value


def test_another_device_on_the_port_or_a_wrong_id_is_said_with_device_port_and_remedy() -> None:
    with ExitStack() as stack, ThreadPoolExecutor(8) as pool:
        sides = {
            "tfmini": tfmini.start(scripted.ScriptedProximity(), {}),
            "rplidar": rplidar.start(scripted.ScriptedScanner(), {}),
            "ft300": ft300.start(scripted.ScriptedForceTorque(), {}),
            "gripper": robotiq_2f.start(scripted.ScriptedGripper(), {}),
        }
        for side in sides.values():
            stack.callback(side.close)
        tried = {
            "bota_here": ("serial:bota", {"port": sides["tfmini"].address["port"]}),
            "rplidar_here": ("serial:rplidar", {"port": sides["ft300"].address["port"]}),
            "ft300_here": ("serial:ft300", {"port": sides["rplidar"].address["port"]}),
            "unit_5": ("modbus:robotiq_2f", {**sides["gripper"].address, "unit": 5}),
        }
        waiting = {name: pool.submit(refusal, name, *what) for name, what in tried.items()}
        for name, future in waiting.items():
            error = future.result()
            assert name in error.what and error.hint
            assert error.details["device"] == name
            assert tried[name][1]["port"] in str(error.details["link"])


ARM = kinematics_of(scripted.ScriptedArm().capabilities())
SHORT_ARM = {**ARM, "lower_rad": ARM["lower_rad"][:5]}


@pytest.mark.parametrize(
    ("driver", "options", "says"),
    [
        ("ur:rtde", {"host": "127.0.0.1", "kinematics": SHORT_ARM}, "same number of entries"),
        ("ur:rtde", {"host": "127.0.0.1", "kinematics": {**ARM, "lower_rad": ARM["upper_rad"]}}, "below its upper_rad"),
        (
            "ur:rtde",
            {"host": "127.0.0.1", "kinematics": {k: v[:5] if isinstance(v, list) else v for k, v in ARM.items()}},
            "6 joints, not 5",
        ),
        ("can:cia402", {"channel": "/dev/null", "kinematics": ARM, "nodes": [1, 2, 3]}, "nodes must be 6 different"),
        ("can:cia402", {"channel": "/dev/null", "kinematics": ARM, "host_node": 3}, "host_node 3"),
        ("serial:dynamixel", {"port": "/dev/null", "kinematics": ARM, "ids": [1, 2, 3, 4, 5, 5]}, "ids must be 6"),
        ("serial:dynamixel", {"port": "/dev/null", "kinematics": ARM, "directions": [1, -1]}, "directions"),
        ("serial:dynamixel", {"port": "/dev/null", "kinematics": ARM, "directions": [1, 1, 1, 1, 1, 0]}, "directions"),
        ("serial:dynamixel_gripper", {"port": "/dev/null", "open_count": 9, "closed_count": 9}, "must differ"),
        ("modbus:robotiq_2f", {"port": "/dev/null", "open_count": 9, "closed_count": 9}, "must differ"),
        ("modbus:robotiq_2f", {"port": "/dev/null", "min_force_n": 235.0}, "below max_force_n"),
    ],
)
def test_options_that_contradict_each_other_are_refused_before_a_port_is_opened(
    driver: str, options: dict[str, Any], says: str
) -> None:
    with pytest.raises(ConfigError, match=says) as caught:
        connect(Context(name="thing"), driver, options)
    assert "devices.thing.options" in caught.value.what


SERIAL: dict[str, dict[str, Any]] = {
    "serial:tfmini": {},
    "modbus:tfmini": {},
    "can:tfmini": {},
    "serial:ft300": {},
    "modbus:ft300": {},
    "modbus:robotiq_2f": {},
    "modbus:lights": {},
    "serial:bota": {},
    "scip:scanner": {},
    "serial:lms200": {},
    "serial:rplidar": {},
    "can:cia402": {"kinematics": ARM},
    "serial:dynamixel": {"kinematics": ARM},
    "serial:dynamixel_gripper": {},
}
NETWORK: dict[str, dict[str, Any]] = {
    "modbus:touch": {},
    "scip:scanner": {},
    "ur:rtde": {},
    "ur:lights": {"outputs": [0, 1, 2, 3]},
    "ros2:arm": {"joints": [f"joint_{i}" for i in range(len(ARM["links"]))], "kinematics": ARM},
    "ros2:gripper": {"joint": "finger_joint"},
    "ros2:force_torque": {},
}


class Chatter:
    """Server that is not a device: it does not answer, sends noise, or closes every connection."""

    def __init__(self, port: FarPort, way: str) -> None:
        self.port = port
        self._way = way
        self._ending = threading.Event()
        self._noise = random.Random(5)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ending.is_set():
            heard = self.port.receive(0.01)
            if self._way == "noise":
                self.port.send(None, self._noise.randbytes(50))
            elif self._way == "hangs up" and heard:
                self.port.vanish()
                self.port.appear()

    def close(self) -> None:
        """End the server."""
        self._ending.set()
        self._thread.join()
        self.port.close()


@pytest.mark.parametrize(
    ("way", "hint"),
    [
        ("silent", "no byte has arrived"),
        ("noise", "bytes arrive, but none of them form a valid answer"),
        ("missing", "plug the device in"),
    ],
)
def test_every_serial_driver_says_what_is_wrong_with_its_port(
    way: str, hint: str, caplog: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    for driver_file in ("cia402.arm", "dynamixel.arm", "dynamixel.gripper", "lms200"):
        monkeypatch.setattr(f"drivers.{driver_file}.CONNECT_S", 3.0)  # as for the other drivers
    with ExitStack() as stack, ThreadPoolExecutor(len(SERIAL)) as pool:
        waiting = {}
        for driver, options in SERIAL.items():
            side = Chatter(PtyPort("line"), way)
            stack.callback(side.close)
            path = "/dev/serial/by-id/none" if way == "missing" else side.port.address["port"]
            key = "channel" if driver.startswith("can:") else "port"
            waiting[driver, path] = pool.submit(refusal, "finger", driver, {key: path, **options})
        for (driver, path), future in waiting.items():
            error = future.result()
            assert "finger" in error.what and hint in error.hint, (driver, error.for_people())
            assert path in f"{error.what} {error.details}", driver
    assert not caplog.records, "a driver failed on bytes that it did not expect"


@pytest.mark.parametrize("way", ["silent", "noise", "hangs up"])
def test_every_network_driver_names_the_address(way: str, caplog: Any) -> None:
    with ExitStack() as stack, ThreadPoolExecutor(len(NETWORK)) as pool:
        waiting = {}
        for driver, options in NETWORK.items():
            side = Chatter(TcpPort(), way)
            stack.callback(side.close)
            address = side.port.address
            waiting[driver, address["port"]] = pool.submit(refusal, "finger", driver, {**address, **options})
        for (driver, number), future in waiting.items():
            error = future.result()
            assert "finger" in error.what and error.hint, (driver, error.for_people())
            assert str(number) in f"{error.what} {error.details}", driver
    assert not caplog.records, "a driver failed on bytes that it did not expect"


class OldController:
    """UR controller that supports version 1 of RTDE only."""

    def __init__(self) -> None:
        self.port = TcpPort()
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        parser = rtde.PackageParser()
        while not self._ending.is_set():
            for peer, data in self.port.receive(0.01):
                for kind, _ in parser.feed(data):
                    self.port.send(peer, rtde.package(kind, b"\x00"))

    def close(self) -> None:
        """End the controller."""
        self._ending.set()
        self._thread.join()
        self.port.close()


@pytest.mark.parametrize("driver", ["ur:rtde", "ur:lights"])
def test_a_protocol_version_that_the_device_does_not_know_is_said(driver: str) -> None:
    with closing(OldController()) as side:
        error = refusal("arm", driver, {**side.port.address, **NETWORK[driver]})
    assert "does not speak RTDE version 2" in error.what
    assert error.details["device"] == "arm" and str(side.port.address["port"]) in error.details["link"]


@pytest.mark.parametrize("call", ["read", "write", "close"])
def test_a_port_that_vanishes_in_a_call_is_an_error_of_the_device_or_none(call: str) -> None:
    far_side = modbus_io.start(scripted.ScriptedLights(), {"transport": "rtu"})
    with wired(far_side, "modbus:lights") as device:
        device.read_on(deadline=soon())
        far_side.port.vanish()
        if call == "close":
            device.close()
            return
        with pytest.raises(CellError) as caught:
            if call == "write":
                device.set_on((True,) * 4, deadline=soon(0.3))
            else:
                device.newest(soon(0.3), not_before_s=soon(0.0).at_s)
    assert "wired" in caught.value.what and caught.value.hint


@pytest.mark.parametrize(
    ("driver", "options", "key"),
    [
        ("serial:tfmini", {"port": "x", "rate_hz": float("nan")}, "rate_hz"),
        ("serial:tfmini", {"port": ""}, "port"),
        ("scip:scanner", {"port": ""}, "port"),
        ("udp:netft", {"host": "127.0.0.1", "counts_per_n": 0.0}, "counts_per_n"),
        ("serial:rplidar", {"port": "x", "mode": "dense"}, "mode"),
        ("modbus:tfmini", {"port": "x", "unit": 0}, "unit"),
        ("can:tfmini", {"channel": "x", "bitrate": 123}, "bitrate"),
        ("serial:dynamixel_gripper", {"port": "x", "stroke_m": float("inf")}, "stroke_m"),
    ],
)
def test_options_out_of_range_are_answered_with_their_key(driver: str, options: dict[str, Any], key: str) -> None:
    with pytest.raises(ConfigError, match=rf"devices\.dut\.options.*{key}"):
        connect(Context(name="dut"), driver, options)
