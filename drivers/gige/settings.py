"""Options of `gige:camera`, and how they are written to a camera and read back."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from drivers.gige.aravis import AravisCamera
from drivers.kinds.cameras import LensOptions
from hal.camera_settings import CameraSettings
from hal.wires import ResourceClaim, WireOptions

OFF, CONTINUOUS = 0, 2  # ArvAuto
US = 1e6
Feature = bool | int | float | str


class GigeCameraOptions(LensOptions, WireOptions):
    """Options of `gige:camera`; what is left out stays as it is set in the camera."""

    camera: Annotated[
        str,
        Field(
            min_length=1,
            description="IP address, which is found again fastest, or id (`Vendor-Model-Serial`), MAC address or "
            "user-defined name; the error about a wrong one lists the cameras that answer",
        ),
    ]
    width_px: Annotated[
        Annotated[int, Field(ge=1, le=20_000)] | None, Field(description="width of the region that is sent")
    ] = None
    height_px: Annotated[
        Annotated[int, Field(ge=1, le=20_000)] | None, Field(description="height of the region that is sent")
    ] = None
    offset_x_px: Annotated[int, Field(ge=0, le=20_000, description="first column of the region")] = 0
    offset_y_px: Annotated[int, Field(ge=0, le=20_000, description="first row of the region")] = 0
    pixel_format: Annotated[str | None, Field(description="GenICam name, such as `Mono8` or `BayerRG8`")] = None
    is_colour: Annotated[bool, Field(description="give RGB where the camera sends colour; false gives grey")] = True
    rate_hz: Annotated[float, Field(gt=0, le=2000, description="frames per second while the camera runs freely")] = 25.0
    trigger: Annotated[
        Literal["free-run", "software"],
        Field(description="`software`: each read starts one exposure; `free-run`: the camera exposes by itself"),
    ] = "free-run"
    exposure_s: Annotated[
        Annotated[float, Field(gt=0, le=10)] | Literal["auto"] | None,
        Field(description="exposure time; `auto` lets the camera choose"),
    ] = None
    gain_db: Annotated[
        Annotated[float, Field(ge=-50, le=100)] | Literal["auto"] | None,
        Field(description="gain; `auto` lets the camera choose"),
    ] = None
    white_balance: Annotated[
        tuple[float, float] | Literal["auto"] | None,
        Field(description="gain of red and of blue; `auto` lets the camera choose"),
    ] = None
    features: Annotated[
        dict[str, Feature],
        Field(description="further GenICam features, written in this order before the stream starts"),
    ] = {}
    packet_bytes: Annotated[
        Annotated[int, Field(ge=576, le=16_000)] | None,
        Field(description="size of a network packet; negotiated if left out"),
    ] = None
    packet_delay_ns: Annotated[int, Field(ge=0, description="pause between two packets of the camera")] = 0
    socket_buffer_bytes: Annotated[
        int,
        Field(ge=65_536, le=1 << 28, description="receive buffer; the system caps it at `net.core.rmem_max`"),
    ] = 8 << 20
    uses_packet_socket: Annotated[
        bool,
        Field(description="receive below the IP layer: less load, but needs CAP_NET_RAW and sees one interface only"),
    ] = False

    def claims(self) -> tuple[ResourceClaim, ...]:
        """Claim the camera."""
        return (ResourceClaim(wire=f"camera {self.camera}"),)


def write(camera: AravisCamera, options: GigeCameraOptions) -> None:
    """Write the options to an open camera.

    Raises:
        AravisError: the camera refuses a value, or does not answer.
    """
    camera.do("set_acquisition_mode", 0)  # continuous
    if options.pixel_format is not None:
        camera.do("set_pixel_format_from_string", options.pixel_format)
    _write_region(camera, options)
    for name, value in options.features.items():
        _write_feature(camera, name, value)
    camera.do("clear_triggers")
    if options.trigger == "software":
        camera.do("set_trigger", "Software")
    else:
        camera.do("set_frame_rate", options.rate_hz)
    if options.exposure_s is not None:
        _write_or_leave_to_camera(camera, "exposure_time", "exposure", options.exposure_s, US)
    if options.gain_db is not None:
        _write_or_leave_to_camera(camera, "gain", "gain", options.gain_db, 1.0)
    _write_white_balance(camera, options)
    if camera.is_network:
        _write_transport(camera, options)


def read_back(camera: AravisCamera, options: GigeCameraOptions) -> CameraSettings:
    """Return the settings that the camera reports."""
    return CameraSettings(
        pixel_format=camera.do("get_pixel_format_as_string"),
        trigger=options.trigger,
        exposure_s=exposure_of(camera),
        exposure_range_s=_exposure_range_s(camera),
        gain_db=camera.do("get_gain") if camera.do("is_gain_available") else None,
        white_balance=_read_white_balance(camera) if options.white_balance != "auto" else None,
        stamped_by="device",
    )


def exposure_of(camera: AravisCamera) -> float | None:
    """Return the present exposure time in seconds, or None if the camera does not tell it."""
    if not camera.do("is_exposure_time_available"):
        return None
    return float(camera.do("get_exposure_time")) / US


def _exposure_range_s(camera: AravisCamera) -> tuple[float, float] | None:
    """Return the exposures that can be set; None if the camera chooses, or has no such setting."""
    if not camera.do("is_exposure_time_available"):
        return None
    if camera.do("is_exposure_auto_available") and camera.do("get_exposure_time_auto") != OFF:
        return None
    least_us, longest_us = camera.exposure_bounds_us()
    return least_us / US, longest_us / US


def _write_region(camera: AravisCamera, options: GigeCameraOptions) -> None:
    _, _, width, height = camera.region()
    wanted = (options.width_px or width, options.height_px or height)
    if (options.width_px, options.height_px) != (None, None) or options.offset_x_px or options.offset_y_px:
        camera.do("set_region", options.offset_x_px, options.offset_y_px, *wanted)


def _write_feature(camera: AravisCamera, name: str, value: Feature) -> None:
    kind = {bool: "boolean", int: "integer", float: "float", str: "string"}[type(value)]
    camera.do(f"set_{kind}", name, value)


def _write_or_leave_to_camera(
    camera: AravisCamera, setting: str, auto: str, value: float | Literal["auto"], scale: float
) -> None:
    can_choose = camera.do(f"is_{auto}_auto_available")
    if value == "auto":
        camera.do(f"set_{setting}_auto", CONTINUOUS)
        return
    if can_choose:
        camera.do(f"set_{setting}_auto", OFF)
    camera.do(f"set_{setting}", value * scale)


def _write_white_balance(camera: AravisCamera, options: GigeCameraOptions) -> None:
    if options.white_balance is None:
        return
    is_auto = options.white_balance == "auto"
    if is_auto or camera.has("BalanceWhiteAuto"):
        camera.do("set_string", "BalanceWhiteAuto", "Continuous" if is_auto else "Off")
    if not is_auto:
        for channel, ratio in zip(("Red", "Blue"), options.white_balance, strict=True):
            camera.do("set_string", "BalanceRatioSelector", channel)
            camera.do("set_float", "BalanceRatio", ratio)


def _read_white_balance(camera: AravisCamera) -> tuple[float, float] | None:
    if not camera.has("BalanceRatio"):
        return None
    ratios = []
    for channel in ("Red", "Blue"):
        camera.do("set_string", "BalanceRatioSelector", channel)
        ratios.append(float(camera.do("get_float", "BalanceRatio")))
    return ratios[0], ratios[1]


def _write_transport(camera: AravisCamera, options: GigeCameraOptions) -> None:
    if options.packet_bytes is None:
        camera.do("gv_auto_packet_size")
    else:
        camera.do("gv_set_packet_size", options.packet_bytes)
    if options.packet_delay_ns:
        camera.do("gv_set_packet_delay", options.packet_delay_ns)
    if not options.uses_packet_socket:
        camera.disable_packet_socket()
