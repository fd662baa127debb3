"""The alarms of a cell as conditions of an OPC UA server (OPC 10000-9): events, refresh, and
acknowledgement and comments if allowed.

Alarms are AlarmConditionType events of the Server object, and each has an instance of that type at its object, whose parts
always hold what its newest event said, for clients that read and do not subscribe. `State` is our own part: the state by
ISA-18.2. asyncua answers ConditionRefresh with the newest event of each condition that is retained.
"""

from __future__ import annotations

import copy
import functools
import logging
import uuid
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from asyncua import Node, Server, ua
from asyncua.common.methods import uamethod
from asyncua.server.event_generator import EventGenerator

from hal.errors import CellError
from service.outlets.opcua_nodes import add_node, moment
from service.outlets.source import Deed

SEVERITY = {"urgent": 900, "high": 700, "medium": 500, "low": 300}
UNACKNOWLEDGED = ("unacknowledged", "returned-unacknowledged")
OWN_STATE = "State"
PROPERTIES = {
    "EventId": ua.VariantType.ByteString, "EventType": ua.VariantType.NodeId, "SourceNode": ua.VariantType.NodeId,
    "SourceName": ua.VariantType.String, "Time": ua.VariantType.DateTime, "ReceiveTime": ua.VariantType.DateTime,
    "Message": ua.VariantType.LocalizedText, "Severity": ua.VariantType.UInt16,
    "ConditionClassId": ua.VariantType.NodeId, "ConditionClassName": ua.VariantType.LocalizedText,
    "ConditionName": ua.VariantType.String, "BranchId": ua.VariantType.NodeId, "Retain": ua.VariantType.Boolean,
    "ClientUserId": ua.VariantType.String, "InputNode": ua.VariantType.NodeId,
    "SuppressedOrShelved": ua.VariantType.Boolean,
}  # fmt: skip
CONDITION_VARIABLES = {
    "Quality": ua.VariantType.StatusCode, "LastSeverity": ua.VariantType.UInt16, "Comment": ua.VariantType.LocalizedText,
}  # fmt: skip
TWO_STATES = {  # the words of OPC 10000-9 for false and true
    "EnabledState": ("Disabled", "Enabled"), "ActiveState": ("Inactive", "Active"),
    "AckedState": ("Unacknowledged", "Acknowledged"), "SuppressedState": ("Unsuppressed", "Suppressed"),
    "OutOfServiceState": ("In Service", "Out of Service"),
}  # fmt: skip
METHODS: dict[Deed, int] = {
    "acknowledge": ua.ObjectIds.AcknowledgeableConditionType_Acknowledge,
    "comment": ua.ObjectIds.ConditionType_AddComment,
}
Act = Callable[[str, Deed, str], Awaitable[None]]
log = logging.getLogger(__name__)


class Conditions:
    """The conditions of a server.

    Args:
        act: acknowledges an alarm or comments on it, by its name and with a comment; None if clients may not.
    """

    def __init__(self, server: Server, *, act: Act | None) -> None:
        self._server, self._act = server, act
        self._template: Any = None
        self._nodes: dict[str, Node] = {}
        self._told: dict[str, tuple[Any, ...]] = {}
        self._events: dict[str, bytes] = {}

    async def start(self) -> None:
        """Prepare events, and the methods that clients may call."""
        generator = await self._server.get_event_generator(ua.ObjectIds.AlarmConditionType, ua.ObjectIds.Server)
        self._template = _event_of(generator)
        for deed, method in METHODS.items() if self._act is not None else ():
            self._server.link_method(self._server.get_node(method), uamethod(functools.partial(self._on_call, deed)))

    async def tell(self, alarm: Mapping[str, Any], source: Node, priority: str) -> None:
        """Show an alarm at its object, and send an event if it is another than before."""
        name, state, is_active = alarm["id"], alarm["state"], bool(alarm["is_active"])
        known = (state, is_active, alarm["changed_s"], alarm["by"])
        if self._told.get(name) == known:
            return
        is_new = name not in self._told
        self._told[name] = known
        node = await self._node(name, source)
        event = self._event(alarm, node, source, priority)
        await self._show(node, event, state=state)
        if not (is_new and state == "normal"):  # what never was is no news
            await self._server.iserver.subscription_service.trigger_event(event)

    async def _show(self, node: Node, event: Any, *, state: str) -> None:
        """Write what an event says into the parts of its condition, whose names are those of the event's fields."""
        parts = {**PROPERTIES, **CONDITION_VARIABLES}
        for name in TWO_STATES:
            parts |= {name: ua.VariantType.LocalizedText, f"{name}/Id": ua.VariantType.Boolean}
        values = {name: ua.Variant(getattr(event, name), kind) for name, kind in parts.items()}
        values |= {
            f"{name}/SourceTimestamp": ua.Variant(event.Time, ua.VariantType.DateTime) for name in CONDITION_VARIABLES
        }
        values[OWN_STATE] = ua.Variant(state, ua.VariantType.String)
        for name, value in values.items():
            path = f"{node.nodeid.Identifier}.{name.replace('/', '.')}"
            told = ua.DataValue(value, SourceTimestamp=event.Time)
            await self._server.write_attribute_value(ua.NodeId(path, node.nodeid.NamespaceIndex), told)

    def _event(self, alarm: Mapping[str, Any], node: Node, source: Node, priority: str) -> Any:
        state, is_active = alarm["state"], bool(alarm["is_active"])
        is_acknowledged, suppressed = state not in UNACKNOWLEDGED, state in ("shelved", "out-of-service")
        event = copy.deepcopy(self._template)  # asyncua keeps it, to answer ConditionRefresh
        event.EventId = self._events[alarm["id"]] = uuid.uuid4().bytes
        event.NodeId, event.SourceNode, event.SourceName = node.nodeid, source.nodeid, alarm["object"]
        event.InputNode = source.nodeid
        event.Time = event.ReceiveTime = moment(alarm["changed_s"] or 0.0)
        event.ConditionName, event.ClientUserId = alarm["id"], alarm["by"]
        event.ConditionClassId = ua.NodeId(ua.ObjectIds.ProcessConditionClassType)
        event.ConditionClassName = ua.LocalizedText("ProcessConditionClassType")
        event.Message, event.Comment = ua.LocalizedText(alarm["says"] or state), ua.LocalizedText(alarm["reason"])
        event.Severity = event.LastSeverity = SEVERITY.get(priority, 500)
        event.Quality, event.BranchId = ua.StatusCode(ua.StatusCodes.Good), ua.NodeId()
        event.Retain = state != "normal"
        event.SuppressedOrShelved = suppressed
        holding = {
            "EnabledState": True,
            "ActiveState": is_active,
            "AckedState": is_acknowledged,
            "SuppressedState": state == "shelved",
            "OutOfServiceState": state == "out-of-service",
        }
        for part, holds in holding.items():
            setattr(event, part, ua.LocalizedText(TWO_STATES[part][holds], "en"))
            setattr(event, f"{part}/Id", holds)
        return event

    async def _node(self, name: str, source: Node) -> Node:
        if name not in self._nodes:
            kind = ua.ObjectIds.AlarmConditionType
            self._nodes[name] = node = await add_node(source, name.partition(".")[2], path=name, kind=kind)
            await source.add_reference(node, ua.ObjectIds.HasCondition)
            await self._add_parts(node)
            for method in METHODS.values() if self._act is not None else ():  # a client may call what it finds here
                await node.add_reference(ua.NodeId(method), ua.ObjectIds.HasComponent)
        return self._nodes[name]

    async def _add_parts(self, node: Node) -> None:
        """Add the parts of a condition that OPC 10000-9 names, and its state in our own words."""
        path = str(node.nodeid.Identifier)
        has_property, has_component = ua.ObjectIds.HasProperty, ua.ObjectIds.HasComponent
        await add_node(node, OWN_STATE, path=f"{path}.{OWN_STATE}", variable=ua.VariantType.String)
        for name, kind in PROPERTIES.items():
            own = ua.ObjectIds.PropertyType
            await add_node(node, name, path=f"{path}.{name}", kind=own, variable=kind, standard=has_property)
        for name, kind in CONDITION_VARIABLES.items():
            own = ua.ObjectIds.ConditionVariableType
            part = await add_node(node, name, path=f"{path}.{name}", kind=own, variable=kind, standard=has_component)
            await self._add_property(part, "SourceTimestamp", ua.VariantType.DateTime)
        for name in TWO_STATES:
            own, words = ua.ObjectIds.TwoStateVariableType, ua.VariantType.LocalizedText
            part = await add_node(node, name, path=f"{path}.{name}", kind=own, variable=words, standard=has_component)
            await self._add_property(part, "Id", ua.VariantType.Boolean)

    async def _add_property(self, part: Node, name: str, kind: ua.VariantType) -> None:
        path, own = f"{part.nodeid.Identifier}.{name}", ua.ObjectIds.PropertyType
        await add_node(part, name, path=path, kind=own, variable=kind, standard=ua.ObjectIds.HasProperty)

    async def _on_call(self, deed: Deed, condition: ua.NodeId, event_id: bytes | None, comment: Any) -> ua.StatusCode:
        """Answer the method Acknowledge or AddComment of a condition."""
        name, said = str(condition.Identifier), (comment.Text or "") if comment is not None else ""
        if self._act is None or name not in self._events:
            return ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown)
        if event_id != self._events[name]:  # of an older state, which is not what the client means
            return ua.StatusCode(ua.StatusCodes.BadEventIdUnknown)
        if deed == "acknowledge" and self._told[name][0] not in UNACKNOWLEDGED:
            return ua.StatusCode(ua.StatusCodes.BadConditionBranchAlreadyAcked)
        if deed == "comment" and not said:
            return ua.StatusCode(ua.StatusCodes.BadInvalidArgument)
        try:
            await self._act(name, deed, said)
        except CellError as error:
            log.warning("OPC UA: %s of %s is refused: %s", deed, name, error.what)
            return ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)
        return ua.StatusCode(ua.StatusCodes.Good)


def _event_of(generator: EventGenerator) -> Any:
    return generator.event
