"""Client side of an RTDE connection, shared by all clients of a controller: handshake, recipes, data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from drivers.transport.link import Link, NoAnswer, Refused, now_s
from drivers.ur import rtde

ANSWER_S = 0.5
PLAUSIBLE = {"timestamp": (0.0, 1e9), "robot_mode": (-1, 255), "safety_mode": (0, 255), "runtime_state": (0, 255)}


class InUse(Refused):
    """Another client of the controller owns an input that this one asks for."""


class RtdeSession:
    """Sets up the recipes on a new link and decodes its bytes into values.

    Args:
        answer_s: how long to wait for an answer.

    Attributes:
        inputs: recipe of the data sent to the controller; None before `begin` has requested one.
    """

    def __init__(self, *, answer_s: float = ANSWER_S) -> None:
        self._answer_s = answer_s
        self._parser = rtde.PackageParser()
        self._outputs: rtde.Recipe | None = None
        self._last_s = -math.inf
        self.inputs: rtde.Recipe | None = None

    def begin(self, link: Link, *, outputs: Sequence[str], rate_hz: float, inputs: Sequence[str] = ()) -> None:
        """Agree on version 2, set up the recipes, and start the stream.

        Args:
            outputs: variables of the data packages, including `timestamp`. RTDE has no checksum: lost bytes shift all
                that follows them in the package, so preferably one of `PLAUSIBLE` is last.

        Raises:
            Refused: another version, or a variable that the controller does not provide. InUse: another client owns one of
                `inputs`. NoAnswer, LinkLost.
        """
        self._parser, self._last_s = rtde.PackageParser(), -math.inf
        if self._ask(link, rtde.package("V", b"\x00\x02"), "V")[:1] != b"\x01":
            raise Refused("the controller does not speak RTDE version 2", code=2)
        self._outputs = self._recipe(link, rtde.outputs_request(outputs, rate_hz), "O", outputs)
        if inputs:
            self.inputs = self._recipe(link, rtde.package("I", ",".join(inputs).encode()), "I", inputs)
        if self._ask(link, rtde.package("S"), "S")[:1] != b"\x01":
            raise Refused("the controller does not start the stream", code=0)
        self._parser.data_size = rtde.HEADER.size + 1 + self._outputs.packing.size

    def take(self, chunk: bytes) -> list[dict[str, Any]]:
        """Return the values by name of each complete, plausible data package, without repetitions."""
        found = []
        for kind, payload in self._parser.feed(chunk):
            if kind != "U" or self._outputs is None or payload[0] != self._outputs.id:
                continue
            values: dict[str, Any] = self._outputs.unpack(payload)
            device_s = float(values["timestamp"])
            is_plausible = all(low <= values.get(name, low) <= high for name, (low, high) in PLAUSIBLE.items())
            if is_plausible and device_s != self._last_s:
                self._last_s = device_s
                found.append(values)
        return found

    def _recipe(self, link: Link, request: bytes, kind: str, names: Sequence[str]) -> rtde.Recipe:
        answer = self._ask(link, request, kind)
        try:
            return rtde.recipe(answer[0], names, rtde.split_names(answer[1:]))
        except rtde.VariableInUse as error:
            raise InUse(
                f"recipe refused: {error}", code=0, hint="only one client may own it: end the other one"
            ) from None
        except (rtde.RecipeRefused, ValueError, IndexError) as error:
            raise Refused(f"recipe refused: {error}", code=0) from None

    def _ask(self, link: Link, request: bytes, kind: str) -> bytes:
        link.write(request, now_s() + self._answer_s)
        until_s = now_s() + self._answer_s
        while chunk := link.read(until_s):
            for got, payload in self._parser.feed(chunk):
                if got == kind and rtde.package(got, payload) != request:  # else a text in between, or our echo
                    return payload
        raise NoAnswer(f"no answer to RTDE request {kind!r}")
