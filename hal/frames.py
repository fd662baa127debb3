"""The tree of frames with the base as its root; every pose between child and parent has a covariance."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from scipy.spatial.transform import RigidTransform

from hal.config import Cell
from hal.errors import ConfigError, InvalidRequest
from hal.geometry import UncertainPose, certain, compose, identity

BASE = "base"
FLANGE = "flange"


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class FrameTree:
    """Frames by name; each has a parent and a pose `parent_from_child`. Immutable."""

    links: Mapping[str, tuple[str, UncertainPose]]

    def names(self) -> tuple[str, ...]:
        """Names of all frames, the root first."""
        return (BASE, *self.links)

    def parent_of(self, name: str) -> str | None:
        """Return the name of the parent; None for the root.

        Raises:
            InvalidRequest: no such frame.
        """
        if name == BASE:
            return None
        if name not in self.links:
            raise InvalidRequest(f"no frame called {name!r}", hint=f"frames: {', '.join(self.names())}")
        return self.links[name][0]

    def base_from(self, name: str) -> UncertainPose:
        """Return `base_from_<name>`, composed from the root; its covariance assumes that the poses are independent."""
        chain: list[UncertainPose] = []
        while (parent := self.parent_of(name)) is not None:
            chain.append(self.links[name][1])
            name = parent
        pose = certain(identity())
        for parent_from_child in reversed(chain):
            pose = compose(pose, parent_from_child)
        return pose

    def pose(self, parent: str, child: str) -> UncertainPose:
        """Return `<parent>_from_<child>` for any two frames; the covariance of poses that both share counts twice."""
        if parent == BASE:
            return self.base_from(child)
        return compose(self.base_from(parent).inverse(), self.base_from(child))

    def with_frame(self, name: str, parent: str, parent_from_child: UncertainPose) -> FrameTree:
        """Return the same tree with one frame added or moved.

        Raises:
            InvalidRequest: the parent is unknown, or the frame would be its own ancestor.
        """
        ancestor: str | None = parent
        while ancestor is not None:
            if ancestor == name:
                raise InvalidRequest(
                    f"frame {name!r} cannot be its own ancestor",
                    hint="choose a parent that is not attached to this frame",
                )
            ancestor = self.parent_of(ancestor)
        return FrameTree(links={**self.links, name: (parent, parent_from_child)})


def frame_tree(cell: Cell, base_from_flange: RigidTransform) -> FrameTree:
    """Return the frames of a cell: base, flange and every mounted device.

    Raises:
        ConfigError: a mount refers to a frame that does not exist.
    """
    tree = FrameTree(links={FLANGE: (BASE, certain(base_from_flange))})
    waiting = {name: device for name, device in cell.file.devices.items() if device.mount is not None}
    while waiting:
        ready = [name for name, device in waiting.items() if device.mount and device.mount.parent in tree.names()]
        if not ready:
            name, device = next(iter(waiting.items()))
            parent = device.mount.parent if device.mount else ""
            raise ConfigError(
                f"{cell.path}: devices.{name}.mount.parent: no frame called {parent!r}",
                hint=f"frames: {', '.join(tree.names())}",
                file=str(cell.path),
                key=f"devices.{name}.mount.parent",
            )
        for name in ready:
            mount = waiting.pop(name).mount
            record = cell.calibration_of(name)
            if mount is not None and record.mount is not None:
                tree = tree.with_frame(name, mount.parent, record.mount.pose())
    return tree
