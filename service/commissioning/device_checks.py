"""Commissioning checks of single devices: measures, judges in words with a remedy, and draws one picture each.

Nothing but the checked device is connected, and the camera with the lights, and the arm with the wrench sensor.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform

from hal.arrays import Array
from hal.clock import Clock, Deadline
from hal.config import Cell
from hal.devices import DeviceKind
from hal.errors import DeviceError, InvalidRequest
from hal.frames import frame_tree
from service.commissioning import check_pictures
from service.commissioning.conform import Bench
from service.commissioning.image_quality import ImageQuality, quality_of

READ_S = 5.0
SETTLE_S = 0.2
FRAMES, WRENCHES = 5, 200
SHARP_PX, BLURRED_PX, UNEVEN, DIRECTED = 1.3, 2.0, 1.8, 1.6
MOST_CLIPPED, LEAST_BRIGHT, MOST_NOISE, MOST_FLICKER = 0.02, 90.0, 4.0, 0.03
LEAST_LIT, NOISE_FACTOR, MOST_RESIDUAL_N = 40.0, 3.0, 2.0
SWING_RAD, SWING_S, MOST_LAG_S, MOST_REST_RAD = 0.035, 4.0, 0.15, 0.004
GRAVITY_M_PER_S2 = 9.80665
Gray = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, kw_only=True)
class Finding:
    """One judgement of a check, with the remedy if it is not good."""

    is_good: bool
    what: str
    remedy: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class DeviceCheck:
    """The result of a check: its findings and its picture as PNG."""

    device: str
    findings: tuple[Finding, ...]
    png: bytes

    @property
    def is_good(self) -> bool:
        """Whether every finding is good."""
        return all(finding.is_good for finding in self.findings)


def check_device(cell: Cell, name: str, *, may_move: Callable[[str], bool]) -> DeviceCheck:
    """Check a camera, a force/torque sensor, the lights or the arm.

    Args:
        may_move: asked with a description before the arm moves; if it returns false, nothing moves.

    Raises:
        InvalidRequest: no such device, or a kind without such a check; or the motion was not confirmed.
        DeviceError: the device does not answer.
    """
    section = cell.file.devices.get(name)
    if section is None:
        raise InvalidRequest(
            f"{cell.path.name} has no device {name!r}", hint=f"devices: {', '.join(cell.file.devices)}"
        )
    checks: dict[DeviceKind, Callable[[Bench], DeviceCheck]] = {
        DeviceKind.CAMERA: lambda bench: _check_camera(bench, name),
        DeviceKind.FORCE_TORQUE: lambda bench: _check_wrench(cell, bench, name),
        DeviceKind.LIGHTS: lambda bench: _check_lights(cell, bench, name),
        DeviceKind.ARM: lambda bench: _check_arm(bench, name, may_move),
    }
    if section.kind not in checks:
        raise InvalidRequest(
            f"{name} is a {section.kind}, which has no check with a picture",
            hint=f"`panelwright conform` tests it; pictures are for {', '.join(checks)}",
        )
    bench = Bench(cell)
    try:
        return checks[section.kind](bench)
    finally:
        bench.close()


def _check_camera(bench: Bench, name: str) -> DeviceCheck:
    with closing(bench.connect(name)) as camera:
        frames = _grays(camera, bench.clock, name)
    quality = quality_of(frames)
    return DeviceCheck(
        device=name,
        findings=tuple(camera_findings(quality)),
        png=check_pictures.camera(frames[-1], quality),
    )


def camera_findings(q: ImageQuality) -> list[Finding]:
    """Judge focus, blur, exposure, noise and flicker."""
    found = []
    if q.is_frozen:
        found.append(
            Finding(is_good=False, what="all frames are equal to the last bit", remedy="power-cycle the camera")
        )
    if not np.isfinite(q.blur_px):
        found.append(
            Finding(is_good=False, what="no edges in the image", remedy="uncover the lens, and point it at the panel")
        )
    else:
        sharp = q.blur_px <= BLURRED_PX
        what = (
            f"focus: edges are blurred by {q.blur_px:.2f} px (one sigma; good below {SHARP_PX}, bad above {BLURRED_PX})"
        )
        found.append(
            Finding(is_good=sharp, what=what, remedy="turn the focus ring at the working distance, then lock it")
        )
        uneven = np.nanmax(q.blur_map_px) / max(q.blur_px, 0.3)
        found.append(
            Finding(
                is_good=bool(uneven < 2 * UNEVEN),
                what=f"sharpness: the worst part of the image is blurred {uneven:.1f} times as much as the middle value",
                remedy="clean the lens; if one side is blurred, the lens is loose or tilted",
            )
        )
        found.append(
            Finding(
                is_good=bool(q.directed < DIRECTED),
                what=f"motion: edges across one direction are {q.directed:.2f} times as blurred as across the other",
                remedy="hold the arm still, stiffen the mount, or expose shorter",
            )
        )
    found.append(
        Finding(
            is_good=bool(q.clipped_share < MOST_CLIPPED and q.bright_level > LEAST_BRIGHT),
            what=f"exposure: {q.clipped_share:.1%} of the pixels are saturated, the brightest 5 % begin at {q.bright_level:.0f}"
            " of 255",
            remedy="expose shorter, or shade the glare"
            if q.clipped_share >= MOST_CLIPPED
            else "expose longer, or add light",
        )
    )
    found.append(
        Finding(
            is_good=bool(q.noise < MOST_NOISE),
            what=f"noise: {q.noise:.1f} gray levels from frame to frame",
            remedy="lower the gain and add light",
        )
    )
    found.append(
        Finding(
            is_good=bool(q.flicker < MOST_FLICKER),
            what=f"flicker: the mean brightness varies by {q.flicker:.1%}",
            remedy="expose for whole periods of the mains (10 or 20 ms), or use steady lamps",
        )
    )
    return found


def _check_wrench(cell: Cell, bench: Bench, name: str) -> DeviceCheck:
    with closing(bench.connect(name)) as sensor:
        c = sensor.capabilities()
        times, rows = [], []
        bench.clock.sleep(SETTLE_S)  # a simulated world behind a wire may just have started
        for _ in range(WRENCHES):
            sample = sensor.read_wrench(deadline=Deadline.after(bench.clock, READ_S))
            value = sample.usable(now_s=bench.clock.now_s(), max_age_s=1.0, device=name)
            times.append(sample.host_time_s)
            rows.append([*value.force_n, *value.torque_nm])
            bench.clock.sleep(1.0 / c.rate_hz)
    wrench = np.array(rows)
    noise = wrench.std(axis=0)
    mean = wrench.mean(axis=0)
    found = [
        _compared("force noise", float(noise[:3].max()), NOISE_FACTOR * c.force_sigma_n, "N"),
        _compared("torque noise", float(noise[3:].max()), NOISE_FACTOR * c.torque_sigma_nm, "N m"),
        Finding(
            is_good=bool(np.abs(mean[:3]).max() < 0.5 * c.force_range_n),
            what=f"bias with the tool's weight: {np.array2string(mean[:3], precision=1)} N of {c.force_range_n:.0f} N",
            remedy="look for a cable that pulls or a screw that clamps, then zero the sensor",
        ),
    ]
    expected = _expected_force(cell, bench, name)
    if expected is not None:
        off_n = float(np.linalg.norm(mean[:3] - expected))
        found.append(
            Finding(
                is_good=off_n < MOST_RESIDUAL_N,
                what=f"payload: the force differs by {off_n:.1f} N from bias and weight in the calibration record",
                remedy="`panelwright calibrate tool`, and set the same payload on the pendant",
            )
        )
    return DeviceCheck(device=name, findings=tuple(found), png=check_pictures.wrench(np.array(times), wrench, expected))


def _compared(what: str, value: float, limit: float, unit: str) -> Finding:
    remedy = "hold the arm still; separate the sensor's cable from those of drives, and earth its shield"
    return Finding(is_good=value <= limit, what=f"{what}: {value:.3g} {unit} (good below {limit:.3g})", remedy=remedy)


def _expected_force(cell: Cell, bench: Bench, name: str) -> Array | None:
    """Return bias and weight of the tool (3,) N in sensor axes by the records; None without a record or an arm."""
    from manipulation import Kinematics

    arms = cell.names_of(DeviceKind.ARM)
    if not arms or cell.file.devices[name].mount is None or cell.calibration_of(name).load is None:
        return None
    record = cell.calibration_of(name).load
    assert record is not None  # noqa: S101 - tested above
    with closing(bench.connect(arms[0])) as arm:
        state = arm.read_state(deadline=Deadline.after(bench.clock, READ_S)).value
        flange: RigidTransform = Kinematics.of(arm.capabilities()).flange(state.position_rad)
    base_from_sensor = frame_tree(cell, flange).base_from(name).parent_from_child
    down = base_from_sensor.rotation.inv().apply([0.0, 0.0, -1.0])
    return np.asarray(record.bias_force_n + record.mass_kg * GRAVITY_M_PER_S2 * down)


def _check_lights(cell: Cell, bench: Bench, name: str) -> DeviceCheck:
    cameras = cell.names_of(DeviceKind.CAMERA)
    if not cameras:
        raise InvalidRequest("lights are checked with a camera, and the cell has none", hint="add a camera")
    found: list[Finding] = []
    differences, peaks = [], []
    with closing(bench.connect(name)) as lights, closing(bench.connect(cameras[0])) as camera:
        channels = lights.capabilities().channels
        dark = _with_lights(lights, camera, bench.clock, [False] * len(channels), found, channels, cameras[0])
        for k, channel in enumerate(channels):
            on = [k == j for j in range(len(channels))]
            lit = _with_lights(lights, camera, bench.clock, on, found, channels, cameras[0])
            rise = cv2.GaussianBlur(lit.astype(np.float32) - dark, (0, 0), 2.0)
            _, most, _, place = cv2.minMaxLoc(rise)
            differences.append(np.asarray(rise))
            peaks.append((float(place[0]), float(place[1])))
            found.append(
                Finding(
                    is_good=most > LEAST_LIT,
                    what=f"{channel}: brighter by {most:.0f} gray levels at pixel ({place[0]}, {place[1]})",
                    remedy="drive the camera to where it sees the whole panel; then check lamp, fuse and wiring",
                )
            )
        lights.set_on([False] * len(channels), deadline=Deadline.after(bench.clock, READ_S))
    apart = [np.hypot(a[0] - b[0], a[1] - b[1]) for k, a in enumerate(peaks) for b in peaks[:k]]
    if apart and min(apart) < 5.0:
        what = "two channels light up in the same place of the image"
        found.append(
            Finding(is_good=False, what=what, remedy="two outputs switch one lamp, or a reflection outshines it")
        )
    return DeviceCheck(
        device=name, findings=tuple(found), png=check_pictures.lights(dark, differences, peaks, channels)
    )


def _with_lights(
    lights: Any, camera: Any, clock: Clock, on: list[bool], found: list[Finding], channels: tuple[str, ...], name: str
) -> Gray:
    """Switch the lights, note channels whose feedback does not follow, and return a gray image."""
    lights.set_on(on, deadline=Deadline.after(clock, READ_S))
    clock.sleep(max(0.06, lights.capabilities().settle_s))
    seen = lights.read_on(deadline=Deadline.after(clock, READ_S)).value
    wrong = [channel for channel, a, b in zip(channels, seen, on, strict=True) if bool(a) != b]
    if wrong:
        what = f"feedback of {', '.join(wrong)} does not follow the command"
        found.append(
            Finding(is_good=False, what=what, remedy="check lamp, fuse, and which input the feedback is wired to")
        )
    return _gray(camera, clock, name)


def _check_arm(bench: Bench, name: str, may_move: Callable[[str], bool]) -> DeviceCheck:
    words = (
        f"the last joint of {name} will turn by {np.degrees(SWING_RAD):.0f} degrees to and fro during {SWING_S:.0f} s"
    )
    if not may_move(words):
        raise InvalidRequest("the motion was not confirmed, so nothing moved", hint="clear the cell, then confirm it")
    with closing(bench.connect(name)) as arm:
        rate_hz = min(arm.capabilities().command_rate_hz, 500.0)
        arm.enable(deadline=Deadline.after(bench.clock, READ_S))
        home = np.array(arm.read_state(deadline=Deadline.after(bench.clock, READ_S)).value.position_rad)
        times, sent, seen = [], [], []
        try:
            for k in range(round(SWING_S * rate_hz)):
                t = k / rate_hz
                wanted = home.copy()
                wanted[-1] += 1.5 * SWING_RAD * np.sin(2 * np.pi * t / SWING_S) * np.sin(np.pi * t / SWING_S) ** 2
                sent.append(np.array(arm.command_position(wanted, deadline=Deadline.after(bench.clock, READ_S))))
                bench.clock.sleep(1.0 / rate_hz)
                state = arm.read_state(deadline=Deadline.after(bench.clock, READ_S))
                times.append(bench.clock.now_s())
                seen.append(np.array(state.value.position_rad))
        finally:
            arm.stop(deadline=Deadline.after(bench.clock, READ_S))
    times_s, sent_rad, seen_rad = np.array(times) - times[0], np.array(sent), np.array(seen)
    lag_s, rest_rad = lag_of(times_s, sent_rad[:, -1], seen_rad[:, -1])
    others_rad = float(np.abs(seen_rad[:, :-1] - home[:-1]).max())
    slow = float(np.diff(times_s).max() * rate_hz)
    found = (
        Finding(
            is_good=lag_s < MOST_LAG_S,
            what=f"lag: the arm follows its set-points {1e3 * lag_s:.0f} ms later (good below {1e3 * MOST_LAG_S:.0f})",
            remedy="raise servo_gain or lower lookahead_s of the driver, and check that remote control is on",
        ),
        Finding(
            is_good=rest_rad < MOST_REST_RAD,
            what=f"tracking: {1e3 * rest_rad:.2f} mrad rms beside the lag (good below {1e3 * MOST_REST_RAD:.0f})",
            remedy="check payload and speed slider on the pendant, and for something that touches the arm",
        ),
        Finding(
            is_good=others_rad < MOST_REST_RAD,
            what=f"other joints: moved by at most {1e3 * others_rad:.2f} mrad",
            remedy="check the payload on the pendant, and the brakes",
        ),
        Finding(
            is_good=slow < 10.0,
            what=f"timing: the longest pause between set-points was {slow:.1f} periods",
            remedy="connect the arm by cable, and give this process a quieter machine",
        ),
    )
    return DeviceCheck(
        device=name, findings=found, png=check_pictures.arm(times_s, sent_rad[:, -1], seen_rad[:, -1], lag_s)
    )


def lag_of(times_s: Array, sent: Array, seen: Array) -> tuple[float, float]:
    """Return the delay of `seen` behind `sent` that fits best, and the rms of the rest."""
    lags = np.linspace(0.0, 0.4, 201)
    rest = [float(np.sqrt(np.mean((seen - np.interp(times_s - lag, times_s, sent)) ** 2))) for lag in lags]
    best = int(np.argmin(rest))
    return float(lags[best]), rest[best]


def _grays(camera: Any, clock: Clock, name: str) -> list[Gray]:
    frames = []
    for _ in range(FRAMES):
        frames.append(_gray(camera, clock, name))
        clock.sleep(1.0 / max(camera.capabilities().rate_hz, 1.0))
    return frames


def _gray(camera: Any, clock: Clock, name: str) -> Gray:
    from perception.vision import as_gray

    sample = camera.read_image(deadline=Deadline.after(clock, READ_S))
    if sample.value is None:
        raise DeviceError(f"{name} gave no image", hint="see its health: `panelwright devices`", device=name)
    return np.asarray(as_gray(sample.value.pixels), np.uint8)
