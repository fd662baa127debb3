"""Options of an arm of CiA-402 drives, and their checks."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from drivers.cia402.objects import faults_of, parameters_of, read_eds
from drivers.cia402.setup import Parameter
from drivers.kinds.arms import KinematicsOptions, capabilities, require_stations
from drivers.transport.canbus import CanOptions
from hal.devices import ArmCapabilities


class Cia402Options(CanOptions):
    """Options of `can:cia402`; `host_node` is the id of our own heartbeat.

    The thread that sends the SYNCs requests `realtime_priority`, 0 for none; it is no error if the system refuses.
    """

    nodes: Annotated[
        tuple[Annotated[int, Field(ge=1, le=126)], ...], Field(description="node of the drive of each joint")
    ] = (1, 2, 3, 4, 5, 6)
    host_node: Annotated[
        int, Field(ge=1, le=127, description="node of this computer, whose heartbeat the drives monitor")
    ] = 127
    rate_hz: Annotated[float, Field(ge=10, le=500, description="rate of SYNC messages and set-points")] = 100.0
    heartbeat_s: Annotated[
        float, Field(ge=0.02, le=1, description="period of this computer's heartbeat; the drives stop when it is lost")
    ] = 0.1
    realtime_priority: Annotated[
        int,
        Field(ge=0, le=99, description="priority that the thread of the SYNC messages asks the system for; 0 for none"),
    ] = 10
    degrees_per_increment: Annotated[
        float, Field(gt=0, description="angle of one increment of the drives' position")
    ] = 0.001
    eds: Annotated[
        Path | None,
        Field(description="electronic data sheet of the drives (EDS or DCF file), against which objects are checked"),
    ] = None
    parameters: Annotated[
        dict[str, int | Annotated[float, Field(allow_inf_nan=False)]],
        Field(
            description="objects that are written to every drive before it starts, by number (`6065`, `60C2:1`) or, with "
            "`eds`, by name (`Interpolation time period.Interpolation time period value`)"
        ),
    ] = {}
    kinematics: Annotated[KinematicsOptions, Field(description="links, limits and speeds of the arm")]

    def known_arm(self) -> ArmCapabilities:
        """Return the kinematics and limits given by `kinematics`."""
        return capabilities(self.kinematics, command_rate_hz=self.rate_hz, watchdog_s=self.heartbeat_s)

    @model_validator(mode="after")
    def _one_node_a_joint(self) -> Self:
        require_stations("nodes", self.nodes, self.kinematics)
        if self.host_node in self.nodes:
            raise ValueError(f"host_node {self.host_node} is also in nodes: give it a number that no drive has")
        return self

    @model_validator(mode="after")
    def _objects_fit(self) -> Self:
        drive = None if self.eds is None else read_eds(self.eds)
        unfit = [] if drive is None else [f"eds: {fault}" for fault in faults_of(drive, bitrate=self.bitrate)]
        unfit += [f"parameters: {fault}" for fault in parameters_of(self.parameters, drive)[1]]
        if unfit:
            raise ValueError("; ".join(unfit))
        return self

    def written(self) -> list[Parameter]:
        """Return the objects of `parameters`."""
        return parameters_of(self.parameters, None if self.eds is None else read_eds(self.eds))[0]

    @property
    def stations(self) -> tuple[str, ...]:
        """Return one node id per axis."""
        return tuple(f"node {node}" for node in self.nodes)
