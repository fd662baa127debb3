"""The nodes of an OPC UA server: units by their UNECE codes (OPC 10000-8), and one object with its readings."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from asyncua import Node, Server, ua

from service.outlets.source import Instrument

UNECE = "http://www.opcfoundation.org/UA/units/un/cefact"
CODES = {  # common codes of UNECE Recommendation 20
    "bar": "BAR", "mbar": "MBR", "Pa": "PAL", "hPa": "A97", "kPa": "KPA", "MPa": "MPA", "psi": "PS", "l/min": "L2", "l/h": "E32",
    "m3/h": "MQH", "m³/h": "MQH", "A": "AMP", "mA": "4K", "V": "VLT", "mV": "2Z", "kV": "KVT", "W": "WTT", "kW": "KWT",
    "MW": "MAW", "kWh": "KWH", "degC": "CEL", "°C": "CEL", "degF": "FAH", "°F": "FAH", "K": "KEL", "%": "P1", "Hz": "HTZ",
    "rpm": "RPM", "1/min": "RPM", "s": "SEC", "min": "MIN", "h": "HUR", "rad": "C81", "deg": "DD", "°": "DD", "m": "MTR",
    "mm": "MMT", "cm": "CMT", "l": "LTR", "m3": "MTQ", "m³": "MTQ", "kg": "KGM", "N": "NEW", "Nm": "NU",
}  # fmt: skip
NO_VALUE = {"value": ua.VariantType.Double, "state": ua.VariantType.String}
TYPES = {
    **NO_VALUE,
    "sigma": ua.VariantType.Double,
    "confidence": ua.VariantType.Double,
    "cause": ua.VariantType.String,
}
NAMES = {"value": "Value", "state": "State", "sigma": "Sigma", "confidence": "Confidence", "cause": "Cause"}


def unit_of(text: str) -> ua.EUInformation:
    """Return a unit; one that UNECE does not list has the id -1, as OPC 10000-8 asks."""
    code = CODES.get(text)
    number = -1 if code is None else int.from_bytes(code.encode("ascii"), "big")
    return ua.EUInformation(
        NamespaceUri=UNECE if code is not None else "urn:panelwright:units",
        UnitId=number,
        DisplayName=ua.LocalizedText(text),
        Description=ua.LocalizedText(text),
    )


def moment(seconds: float) -> datetime:
    """Return a time since 1970 as a date in UTC."""
    return datetime.fromtimestamp(seconds, UTC)


async def add_node(
    parent: Node,
    name: str,
    *,
    path: str,
    kind: int = ua.ObjectIds.BaseObjectType,
    variable: ua.VariantType | None = None,
    text: str = "",
    standard: int | None = None,
) -> Node:
    """Add an object, or a variable that clients cannot write, with a type and without the optional parts of that type.

    Args:
        standard: the reference from the parent to a part that OPC UA itself names, so that its browse name is of namespace 0;
            None for a component with a name of ours.
    """
    index = parent.nodeid.NamespaceIndex
    item = ua.AddNodesItem(
        RequestedNewNodeId=ua.NodeId(path, index),
        BrowseName=ua.QualifiedName(name, index if standard is None else 0),
        ParentNodeId=parent.nodeid,
        ReferenceTypeId=ua.NodeId(ua.ObjectIds.HasComponent if standard is None else standard),
        TypeDefinition=ua.NodeId(kind),
    )
    attributes: ua.ObjectAttributes | ua.VariableAttributes
    if variable is None:
        item.NodeClass, attributes = ua.NodeClass.Object, ua.ObjectAttributes(EventNotifier=0)
    else:
        item.NodeClass, attributes = (
            ua.NodeClass.Variable,
            ua.VariableAttributes(
                DataType=ua.NodeId(variable.value), ValueRank=ua.ValueRank.Scalar, Value=ua.Variant()
            ),
        )
        attributes.AccessLevel = attributes.UserAccessLevel = ua.AccessLevel.CurrentRead.mask
    attributes.DisplayName, attributes.Description = ua.LocalizedText(name), ua.LocalizedText(text)
    item.NodeAttributes = attributes
    (result,) = await parent.session.add_nodes([item])
    result.StatusCode.check()
    return Node(parent.session, result.AddedNodeId)


class ObjectNode:
    """One object of the panel in the address space; `Value` is there if it has a scale or was read as a number.

    Args:
        node: its object node.
    """

    def __init__(self, server: Server, instrument: Instrument, node: Node) -> None:
        self._server, self._instrument, self.node = server, instrument, node
        self._parts: dict[str, Node] = {}
        self._newest_s = 0.0

    @classmethod
    async def added(cls, server: Server, parent: Node, instrument: Instrument) -> ObjectNode:
        """Return the node of an object, after adding it below `parent`, without a value yet."""
        text = f"{instrument.kind}: {instrument.label}".rstrip(": ")
        one = cls(server, instrument, await add_node(parent, instrument.name, path=instrument.name, text=text))
        for part in ("state" if instrument.low is None else "value", "sigma", "confidence", "cause"):
            await one._part(part)
        await one.tell_nothing(ua.StatusCodes.BadWaitingForInitialData)
        return one

    async def tell(self, reading: Mapping[str, Any]) -> None:
        """Show a reading: Good if it is sure, Uncertain if not, Bad without a value if it was refused; never an older one."""
        if reading["utc_s"] < self._newest_s:
            return
        self._newest_s = reading["utc_s"]
        if reading["quality"] != "valid":
            status = ua.StatusCodes.Bad
        else:
            status = ua.StatusCodes.Good if reading["sure"] else ua.StatusCodes.Uncertain
        for part in TYPES:
            value = reading[part]
            if part in NO_VALUE:
                if value is None and part not in self._parts:
                    continue
                is_other = (
                    status != ua.StatusCodes.Bad and value is None
                )  # a number of what shows a state, or the reverse
                await self._write(part, value, ua.StatusCodes.GoodNoData if is_other else status)
            else:
                await self._write(part, value, ua.StatusCodes.Good)

    async def tell_nothing(self, status: int) -> None:
        """Show that nothing is known, and why; the next reading is shown whatever its time."""
        self._newest_s = 0.0
        for part in list(self._parts):
            await self._write(part, None, status)

    async def _part(self, part: str) -> Node:
        """Return the variable of a part, after adding it the first time it is needed."""
        if part not in self._parts:
            name, scaled = self._instrument.name, part == "value" and self._instrument.low is not None
            kind = ua.ObjectIds.AnalogItemType if scaled else ua.ObjectIds.BaseDataVariableType
            node = await add_node(self.node, NAMES[part], path=f"{name}.{part}", kind=kind, variable=TYPES[part])
            self._parts[part] = node
            if part == "value" and self._instrument.low is not None and self._instrument.high is not None:
                await self._add_property(
                    node, "EURange", ua.Range(Low=self._instrument.low, High=self._instrument.high)
                )
            if part in ("value", "sigma") and self._instrument.unit:
                await self._add_property(node, "EngineeringUnits", unit_of(self._instrument.unit))
        return self._parts[part]

    async def _add_property(self, node: Node, name: str, value: object) -> None:
        path = f"{node.nodeid.Identifier}.{name}"
        await node.add_property(ua.NodeId(path, node.nodeid.NamespaceIndex), ua.QualifiedName(name, 0), value)

    async def _write(self, part: str, value: Any, status: int) -> None:
        node = await self._part(part)
        told = ua.DataValue(
            ua.Variant(value, TYPES[part]) if value is not None else ua.Variant(),
            StatusCode=ua.StatusCode(status),
            SourceTimestamp=moment(self._newest_s) if self._newest_s else None,
            ServerTimestamp=datetime.now(UTC),
        )
        await self._server.write_attribute_value(node.nodeid, told)
