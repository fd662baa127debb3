"""Simulated bodies, one file per kind, and the interface for packages that add another kind."""

from __future__ import annotations

from typing import TYPE_CHECKING

from hal.face import load_on_first_use

if TYPE_CHECKING:
    from simbackend.bodies.body import Body, Start, body_of, picked, place_of
    from simbackend.bodies.parts import ObjectModel, Quad, base, disc, moving, nearest_state
    from simbackend.canvas import FACE_PX_PER_M, Canvas
    from simbackend.mechanisms import Detent, Friction, Mechanism, Spring
    from simbackend.urdf import at, box, cylinder, shape, sphere

__all__ = [
    "FACE_PX_PER_M",
    "Body",
    "Canvas",
    "Detent",
    "Friction",
    "Mechanism",
    "ObjectModel",
    "Quad",
    "Spring",
    "Start",
    "at",
    "base",
    "body_of",
    "box",
    "cylinder",
    "disc",
    "moving",
    "nearest_state",
    "picked",
    "place_of",
    "shape",
    "sphere",
]
if not TYPE_CHECKING:
    __getattr__ = load_on_first_use(__name__, __file__)
