"""The alarms of a cell as conditions of an OPC UA server (OPC 10000-9): events, refresh, and acknowledgement if allowed.

Alarms that clients may list are AlarmConditionType events of the Server object. A condition's node holds what people need to
see without events; asyncua answers ConditionRefresh with the newest event of each condition that is retained.
"""

from __future__ import annotations

import copy
import logging
import uuid
from collections.abc import Awaitable, Callable, Mapping
from typing import Any

from asyncua import Node, Server, ua
from asyncua.common.methods import uamethod
from asyncua.server.event_generator import EventGenerator

from hal.errors import CellError
from service.outlets.opcua_nodes import add_node, moment

SEVERITY = {"urgent": 900, "high": 700, "medium": 500, "low": 300}
UNACKNOWLEDGED = ("unacknowledged", "returned-unacknowledged")
PARTS = {"State": ua.VariantType.String, "Active": ua.VariantType.Boolean, "Message": ua.VariantType.String}
Acknowledge = Callable[[str, str], Awaitable[None]]
log = logging.getLogger(__name__)


class Conditions:
    """The conditions of a server.

    Args:
        acknowledge: acknowledges an alarm, by its name and with a comment; None if clients may not.
    """

    def __init__(self, server: Server, *, acknowledge: Acknowledge | None) -> None:
        self._server, self._acknowledge = server, acknowledge
        self._template: Any = None
        self._nodes: dict[str, Node] = {}
        self._told: dict[str, tuple[Any, ...]] = {}
        self._events: dict[str, bytes] = {}

    async def start(self) -> None:
        """Prepare events, and the one method that clients may call."""
        generator = await self._server.get_event_generator(ua.ObjectIds.AlarmConditionType, ua.ObjectIds.Server)
        self._template = _event_of(generator)
        if self._acknowledge is not None:
            method = self._server.get_node(ua.ObjectIds.AcknowledgeableConditionType_Acknowledge)
            self._server.link_method(method, uamethod(self._on_acknowledge))

    async def tell(self, alarm: Mapping[str, Any], source: Node, priority: str) -> None:
        """Show an alarm at its object, and send an event if it is another than before."""
        name, state, is_active = alarm["id"], alarm["state"], bool(alarm["is_active"])
        known = (state, is_active, alarm["changed_s"], alarm["by"])
        if self._told.get(name) == known:
            return
        is_new = name not in self._told
        self._told[name] = known
        node = await self._node(name, source)
        for part, value in (("State", state), ("Active", is_active), ("Message", alarm["says"])):
            stamp = moment(alarm["changed_s"]) if alarm["changed_s"] else None
            told = ua.DataValue(ua.Variant(value, PARTS[part]), SourceTimestamp=stamp)
            await self._server.write_attribute_value(ua.NodeId(f"{name}.{part}", node.nodeid.NamespaceIndex), told)
        if not (is_new and state == "normal"):  # what never was is no news
            await self._send(alarm, node, source, priority)

    async def _send(self, alarm: Mapping[str, Any], node: Node, source: Node, priority: str) -> None:
        state, is_active = alarm["state"], bool(alarm["is_active"])
        is_acknowledged, suppressed = state not in UNACKNOWLEDGED, state in ("shelved", "out-of-service")
        event = copy.deepcopy(self._template)  # asyncua keeps it, to answer ConditionRefresh
        event.EventId = self._events[alarm["id"]] = uuid.uuid4().bytes
        event.NodeId, event.SourceNode, event.SourceName = node.nodeid, source.nodeid, alarm["object"]
        event.InputNode = source.nodeid
        event.Time = event.ReceiveTime = moment(alarm["changed_s"])
        event.ConditionName, event.ClientUserId = alarm["id"], alarm["by"]
        event.ConditionClassId = ua.NodeId(ua.ObjectIds.ProcessConditionClassType)
        event.ConditionClassName = ua.LocalizedText("ProcessConditionClassType")
        event.Message, event.Comment = ua.LocalizedText(alarm["says"] or state), ua.LocalizedText(alarm["reason"])
        event.Severity = event.LastSeverity = SEVERITY.get(priority, 500)
        event.Quality, event.BranchId = ua.StatusCode(ua.StatusCodes.Good), ua.NodeId()
        event.Retain = state != "normal"
        event.SuppressedOrShelved = suppressed
        for part, holds, words in (
            ("EnabledState", True, ("Disabled", "Enabled")),
            ("ActiveState", is_active, ("Inactive", "Active")),
            ("AckedState", is_acknowledged, ("Unacknowledged", "Acknowledged")),
            ("SuppressedState", state == "shelved", ("Unsuppressed", "Suppressed")),
            ("OutOfServiceState", state == "out-of-service", ("InService", "OutOfService")),
        ):
            setattr(event, part, ua.LocalizedText(words[holds], "en"))
            setattr(event, f"{part}/Id", holds)
        await self._server.iserver.subscription_service.trigger_event(event)

    async def _node(self, name: str, source: Node) -> Node:
        if name not in self._nodes:
            self._nodes[name] = await add_node(source, name.partition(".")[2], path=name)
            for part, kind in PARTS.items():
                await add_node(self._nodes[name], part, path=f"{name}.{part}", variable=kind)
        return self._nodes[name]

    async def _on_acknowledge(self, condition: ua.NodeId, event_id: bytes | None, comment: Any) -> ua.StatusCode:
        """Answer the method Acknowledge of a condition."""
        name = str(condition.Identifier)
        if self._acknowledge is None or name not in self._events:
            return ua.StatusCode(ua.StatusCodes.BadNodeIdUnknown)
        if event_id != self._events[name]:  # of an older state, which is not what the client means to acknowledge
            return ua.StatusCode(ua.StatusCodes.BadEventIdUnknown)
        if self._told[name][0] not in UNACKNOWLEDGED:
            return ua.StatusCode(ua.StatusCodes.BadConditionBranchAlreadyAcked)
        try:
            await self._acknowledge(name, (comment.Text or "") if comment is not None else "")
        except CellError as error:
            log.warning("OPC UA: %s is not acknowledged: %s", name, error.what)
            return ua.StatusCode(ua.StatusCodes.BadUserAccessDenied)
        return ua.StatusCode(ua.StatusCodes.Good)


def _event_of(generator: EventGenerator) -> Any:
    return generator.event
