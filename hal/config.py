"""Cell file: the devices of a cell, where they are mounted, and the limits that apply."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from hal.calibration import CalibrationRecord, Vector3, load_calibration
from hal.devices import DeviceKind
from hal.errors import ConfigError
from hal.outlets import OutletsSection
from hal.panel import Panel, load_panel
from hal.panel.turn import meant_otherwise
from hal.plant import HistorySection, ReviewSection, RoundSection
from hal.simulated_events import EventSection
from hal.strict import Strict, load_toml

Name = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]{0,40}$")]
Positive = Annotated[float, Field(gt=0)]


class CellSection(Strict):
    """`[cell]`"""

    name: Name
    mode: Literal["sim", "real", "mixed"]
    panel: str
    calibrations: str
    knowledge: str | None = None
    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    control_rate_hz: Annotated[float, Field(ge=50, le=1000)] = 500.0


class Mount(Strict):
    """Mount of a device: parent frame (`flange`, `base` or another frame's name) and calibration record of the pose."""

    parent: Name = "flange"
    calibration: Name


class DeviceSection(Strict):
    """`[devices.NAME]`"""

    kind: DeviceKind
    driver: Annotated[str, Field(pattern=r"^[a-z0-9_.+-]+:[a-z0-9_.+-]+$")]
    options: dict[str, Any] = {}
    mount: Mount | None = None
    isolate: bool = False


class EmulatorSection(Strict):
    """`[emulators.NAME]`: emulates device NAME at the other end of its link, backed by a (usually simulated) device."""

    emulator: str
    driver: str
    emulator_options: dict[str, Any] = {}
    options: dict[str, Any] = {}


class CableSection(Strict):
    """`[[simulation.cables]]`: a cable in front of the panel, straight from each point to the next."""

    path_m: Annotated[tuple[Vector3, ...], Field(min_length=2, max_length=50)]
    """Points of the cable's axis, in the panel frame."""
    radius_m: Annotated[float, Field(ge=0.001, le=0.05)] = 0.003
    gray: Annotated[float, Field(ge=0, le=1)] = 0.08

    @model_validator(mode="after")
    def _goes_on(self) -> CableSection:
        if any(a == b for a, b in pairwise(self.path_m)):
            raise ValueError("path_m names a point twice in a row; remove one of them")
        return self


class SimulationSection(Strict):
    """`[simulation]`: things in the simulated world that the panel file does not describe."""

    cables: Annotated[tuple[CableSection, ...], Field(max_length=20)] = ()
    events: Annotated[
        tuple[EventSection, ...], Field(max_length=20, description="what happens in the world while it runs")
    ] = ()
    built_panel: Annotated[
        str | None,
        Field(description="panel file of the panel as built; if null, the panel is as `cell.panel` states it"),
    ] = None
    shows: Annotated[
        dict[Name, float],
        Field(
            description="what instruments and lamps show at first, in place of what the seed draws; a lamp is lit from 0.5 on"
        ),
    ] = {}
    pad_friction: Annotated[float, Field(ge=0.05, le=2.0, description="coefficient of friction of the finger pads")] = (
        0.8
    )
    panel_spread_m: Annotated[
        float, Field(ge=0.0, le=0.5, description="largest shift of the panel along each axis, limited by the tolerance")
    ] = 0.06
    panel_spread_rad: Annotated[
        float, Field(ge=0.0, le=1.0, description="largest turn of the panel, limited by the tolerance")
    ] = 0.14


class BoxSection(Strict):
    """`[[safety.workspace]]`: a box along the axes of the base frame."""

    lower_m: Vector3
    upper_m: Vector3

    @model_validator(mode="after")
    def _is_a_box(self) -> BoxSection:
        if not all(low < high for low, high in zip(self.lower_m, self.upper_m, strict=True)):
            raise ValueError("each number of upper_m must be larger than that of lower_m")
        return self


LossAction = Literal["hold", "retreat", "stop"]


class SafetySection(Strict):
    """`[safety]`"""

    force_limit_n: Annotated[float, Field(gt=0, le=500)] = 100.0
    speed_limit_m_per_s: Annotated[float, Field(gt=0, le=2)] = 0.25
    reduced_speed_m_per_s: Annotated[
        float,
        Field(
            ge=0.02,
            le=0.25,
            description="largest speed of the tool's tip while people are near (POST /v1/speed/reduce)",
        ),
    ] = 0.1
    lease_ttl_s: Annotated[float, Field(ge=0.1, le=10)] = 2.0
    client_lost: Annotated[
        LossAction,
        Field(
            description="what happens when the lease lapses in a motion: `hold` ends the motion and holds the arm, `retreat` then "
            "goes back the way it came (0.1 m at most), `stop` latches the stop and switches the drives off"
        ),
    ] = "hold"
    device_lost: Annotated[
        LossAction, Field(description="the same for a device that fails in a motion; the arm itself always stops")
    ] = "hold"
    wrench_lost: Annotated[
        LossAction, Field(description="the same for a force/torque sensor that is silent or impossible in a motion")
    ] = "hold"
    service_lost: Annotated[
        LossAction,
        Field(
            description="what happens when the service process ends, is suspended or hangs: the stop is latched at once, `stop` "
            "switches the drives off, `hold` leaves them on, `retreat` lets an arm that moved go back first"
        ),
    ] = "stop"
    max_reading_age_s: Positive = 0.1
    joint_limits_rad: Annotated[
        tuple[tuple[float, float], ...],
        Field(description="least and largest angle of each joint, inside the arm's own range; empty for that range"),
    ] = ()
    workspace: Annotated[
        tuple[BoxSection, ...],
        Field(max_length=20, description="boxes that the tool's tip may not leave; empty for no limit"),
    ] = ()
    allowed_places: Annotated[
        tuple[str, ...],
        Field(
            max_length=100,
            description="ports and hosts that devices may get while the cell runs, besides those of this file; * stands for "
            "anything",
        ),
    ] = ()


class WorkspaceSection(Strict):
    """`[workspace]`: expected pose of the panel with its tolerances, the arm's park position, height of the floor."""

    panel_position_m: Vector3
    panel_rpy_rad: Vector3
    position_tolerance_m: Positive = 0.10
    angle_tolerance_rad: Positive = 0.27
    park_rad: tuple[float, ...]
    floor_z_m: float = 0.0
    to_measure: Annotated[
        tuple[Literal["panel_position_m", "panel_rpy_rad", "park_rad", "floor_z_m", "kinematics"], ...],
        Field(description="keys of this table, or `kinematics` of the arm's options, that are still guesses"),
    ] = ()


class HandSection(Strict):
    """`[hand]`: the fingers on the gripper, or one rigid finger where there is none; all sizes in m.

    The grip frame lies at the finger tips: z along the fingers, x in the closing direction.
    """

    fingers: Annotated[
        Literal[1, 2], Field(description="2: two parallel fingers; 1: one rigid finger, which opens and grips nothing")
    ] = 2
    finger_thickness_m: Annotated[float, Field(gt=0, le=0.1, description="of one finger, along x")] = 0.007
    finger_width_m: Annotated[float, Field(gt=0, le=0.1, description="of one finger, along y")] = 0.012
    finger_length_m: Annotated[float, Field(gt=0, le=0.5, description="from the tips back to the body")] = 0.075
    body_half_m: Annotated[Vector3, Field(description="half the edges of the body behind the fingers")] = (
        0.0475,
        0.030,
        0.045,
    )
    body_back_m: Annotated[float, Field(gt=0, le=1, description="from the tips back to the middle of the body")] = 0.125
    max_width_m: Annotated[float, Field(gt=0, le=0.5, description="largest opening of two fingers")] = 0.080
    pad_stiffness_n_per_m: Annotated[
        float, Field(gt=0, description="of the finger pads: a push of F moves the finger F/k past the surface")
    ] = 7_000.0


class CellFile(Strict):
    """Complete cell file."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    cell: CellSection
    devices: Annotated[dict[Name, DeviceSection], Field(min_length=1)]
    workspace: WorkspaceSection
    hand: HandSection = HandSection()
    safety: SafetySection = SafetySection()
    simulation: SimulationSection = SimulationSection()
    history: HistorySection = HistorySection()
    review: ReviewSection = ReviewSection()
    rounds: Annotated[tuple[RoundSection, ...], Field(max_length=100)] = ()
    outlets: OutletsSection = OutletsSection()
    emulators: dict[Name, EmulatorSection] = {}

    @model_validator(mode="after")
    def _stand_ins_have_their_place(self) -> CellFile:
        for name in self.emulators:
            if name not in self.devices:
                known = f"devices: {', '.join(self.devices)}"
                raise ValueError(f"emulators.{name} must have the name of the device that it emulates; {known}")
        names = [one.name for one in self.rounds]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise meant_otherwise(f"several rounds are called {', '.join(twice)}", "give each round its own name")
        if self.emulators and self.cell.mode == "real":
            raise ValueError("emulators need cell.mode = 'mixed' or 'sim'")
        if self.simulation.cables and self.cell.mode == "real":
            raise ValueError("simulation.cables need cell.mode = 'mixed' or 'sim'")
        if self.simulation.shows and self.cell.mode == "real":
            raise ValueError("simulation.shows needs cell.mode = 'mixed' or 'sim'")
        if self.simulation.built_panel is not None and self.cell.mode == "real":
            raise ValueError("simulation.built_panel needs cell.mode = 'mixed' or 'sim'")
        return self


class Cell(Strict):
    """Cell file with the panel and the calibration records that it refers to, all validated."""

    path: Path
    file: CellFile
    panel: Panel
    calibrations: dict[str, CalibrationRecord]
    built_panel: Panel | None = None
    """The panel as the simulator builds it, where that differs from the panel file; nothing else may use it."""

    @property
    def name(self) -> str:
        """Name of the cell."""
        return self.file.cell.name

    def names_of(self, kind: DeviceKind) -> tuple[str, ...]:
        """Return the names of the devices of a kind, in the order of the file."""
        return tuple(name for name, device in self.file.devices.items() if device.kind is kind)

    @property
    def panel_path(self) -> Path:
        """Path of the panel file.

        Raises:
            ConfigError: the file does not exist any more.
        """
        return _locate(self.file.cell.panel, self.path, "cell.panel")

    @property
    def certificate_path(self) -> Path | None:
        """Path of the certificate of readings; None if the cell file names none.

        Raises:
            ConfigError: the file does not exist.
        """
        name = self.file.review.certificate
        return None if name is None else _locate(name, self.path, "review.certificate")

    def calibration_path(self, name: str) -> Path:
        """Return the path of the calibration record called `name`.

        Raises:
            ConfigError: its folder does not exist any more.
        """
        return _locate(self.file.cell.calibrations, self.path, "cell.calibrations") / f"{name}.toml"

    @property
    def knowledge_path(self) -> Path | None:
        """Folder of appearance data for this cell's panel, in addition to the shipped data; None if there is none.

        Raises:
            ConfigError: the folder does not exist any more.
        """
        folder = self.file.cell.knowledge
        return None if folder is None else _locate(folder, self.path, "cell.knowledge")

    def calibration_of(self, device: str) -> CalibrationRecord:
        """Return the calibration record of a mounted device.

        Raises:
            ConfigError: the device has no mount.
        """
        mount = self.file.devices[device].mount
        if mount is None:
            raise ConfigError(
                f"devices.{device} has no mount",
                hint="add mount = { parent = ..., calibration = ... }",
                file=str(self.path),
                key=f"devices.{device}.mount",
            )
        return self.calibrations[mount.calibration]


def load_cell(path: Path, *, seed: int | None = None) -> Cell:
    """Read a cell file, its panel and its calibration records.

    A relative path in the file is looked for in the file's folder and then in its parents, so `panels/bench.toml` works
    whatever the current folder is.

    Args:
        seed: used instead of the file's seed.

    Raises:
        ConfigError: a file is missing or invalid; names the file, the key path and the remedy.
    """
    file = load_toml(path, CellFile, "cell file")
    if seed is not None:
        file = file.model_copy(update={"cell": file.cell.model_copy(update={"seed": seed})})
    panel = load_panel(_locate(file.cell.panel, path, "cell.panel"))
    bare = Cell.model_construct(path=path, file=file, panel=panel, calibrations={})
    _ = bare.knowledge_path  # raises now if the folder is missing, rather than when the first image is taken
    records: dict[str, CalibrationRecord] = {}
    for device, section in file.devices.items():
        if section.mount is not None and section.mount.calibration not in records:
            records[section.mount.calibration] = _record(bare, device, section.mount.calibration)
    return bare.model_copy(update={"calibrations": records, "built_panel": _built_panel(bare)})


def _built_panel(cell: Cell) -> Panel | None:
    """Return the panel of `simulation.built_panel`, which must have the same parts as the cell's panel."""
    text = cell.file.simulation.built_panel
    if text is None:
        return None
    built = load_panel(_locate(text, cell.path, "simulation.built_panel"))
    if _parts(built) != _parts(cell.panel):
        raise ConfigError(
            f"{cell.path}: simulation.built_panel: {text!r} has other lights, tags or objects than cell.panel",
            hint="give both files the same parts, in the same order; only their sizes, places and efforts may differ",
            file=str(cell.path),
            key="simulation.built_panel",
        )
    return built


def _parts(panel: Panel) -> list[tuple[str, str]]:
    objects = [(one.kind, one.name) for one in panel.objects]
    return [*(("light", one.name) for one in panel.lights), *(("tag", one.name) for one in panel.tags), *objects]


def _record(cell: Cell, device: str, name: str) -> CalibrationRecord:
    path = cell.calibration_path(name)
    try:
        return load_calibration(path)
    except ConfigError as error:
        key = f"devices.{device}.mount.calibration"
        raise ConfigError(f"{cell.path}: {key}: {error.what}", hint=error.hint, **error.details) from error


def _locate(text: str, cell_path: Path, key: str) -> Path:
    wanted = Path(text)
    if wanted.is_absolute():
        return wanted
    for folder in cell_path.resolve().parents:
        if (folder / wanted).exists():
            return folder / wanted
    raise ConfigError(
        f"{cell_path}: {key}: {text!r} does not exist",
        file=str(cell_path),
        key=key,
        hint="give a path relative to the cell file's folder or one above it",
    )
