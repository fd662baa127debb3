"""How the simulated fingers give way: rubber pads, on fingers that yield at their root in all three directions.

The root has a spring of `ROOT_STIFFNESS_N_PER_M` along x, y and z of the grip frame. It stands for what gives way between
the pad's surface and the arm's motors: the shear of the rubber, the finger, the gripper's guides and the arm's gears. Two
fingers side by side yield by 30 kN/m; the tip of a collaborative arm of this size yields by 20 to 60 kN/m. Without it any
motion along a surface, however small, is answered by the whole of the friction at once, because the engine's friction
does not yield: a hand that felt for a lever with 3 N met it with 55 N, and its friction jumped by 30 N from tick to tick.

A pad of the modulus E, the area A and the thickness t has the stiffness E A / t. Nitrile rubber of 60 Shore A has E =
3.6 MPa; pressed over 12 mm x 3.5 mm, as by a spoke or the edge of a bar, a layer of 3 mm has 50 kN/m. A face, which the
engine meets in four points, presses a larger area. A pad with 5 kN/m a point gave way by 11 mm to a round spoke that
pressed it with 55 N at one point, and went through it.

Source of E: A. N. Gent, On the relation between indentation hardness and Young's modulus, Rubber Chemistry and
Technology 31, 1958, 896-906: E = 0.0981 (56 + 7.62336 S) / (0.137505 (254 - 2.54 S)) MPa for S Shore A. The damping
of the pads is a loss factor of 0.3 at 16 Hz, that of filled nitrile rubber.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

PAD_STIFFNESS_N_PER_M = 50_000.0
"""Stiffness of a pad at each of the contact points that the engine makes, N/m."""
PAD_DAMPING_N_S_PER_M = 150.0
"""The same of its damping, N s/m."""
ROOT_STIFFNESS_N_PER_M = 15_000.0
"""Stiffness of one finger at its root, along each axis, N/m."""
ROOT_DAMPING_N_S_PER_M = 5.0
"""Damping of one finger at its root, N s/m."""
LONGEST_TICK_S = 0.0025  # in which the spring of the root, with the mass of a finger on it, is stable
RIGID_N = 1000.0


class Pads:
    """The pads of the fingers of an arm.

    Args:
        engine: a connected PyBullet client.
        arm: the engine's number of the arm.
        fingers: the engine's numbers of its fingers.
        friction: of the rubber on anything.

    Attributes:
        force_n: normal force on each finger in the last tick, N.
    """

    def __init__(self, engine: Any, arm: int, fingers: Sequence[int], *, friction: float) -> None:
        self._fingers = tuple(fingers)
        self.force_n = (0.0,) * len(self._fingers)
        for finger in self._fingers:
            engine.changeDynamics(
                arm,
                finger,
                lateralFriction=friction,
                contactStiffness=PAD_STIFFNESS_N_PER_M,
                contactDamping=PAD_DAMPING_N_S_PER_M,
            )

    def note(self, contacts: Sequence[Any]) -> None:
        """Note a tick's contact points of the arm, as the engine returns them."""
        forces = [0.0] * len(self._fingers)
        for contact in contacts:
            if contact[3] in self._fingers:
                forces[self._fingers.index(contact[3])] += contact[9]
        self.force_n = tuple(forces)


class Roots:
    """The yielding roots of the fingers; in ticks that are too long for their springs the fingers are rigid.

    The springs are plain forces on the joints, also where the gripper drives a finger: along x the spring's place of
    rest moves with the gripper. A motor of the engine at that joint would be simpler, but the engine then reports a
    force at the wrist that is wrong by up to a third along x.

    Args:
        engine: a connected PyBullet client.
        arm: the engine's number of the arm.
        fingers: for each finger the engine's numbers of its joints along x, y and z.
    """

    def __init__(self, engine: Any, arm: int, fingers: Sequence[Sequence[int]], *, dt_s: float) -> None:
        self.yields = dt_s <= LONGEST_TICK_S
        for finger in fingers:
            for joint in finger:
                holding_n = 0.0 if self.yields else RIGID_N
                engine.setJointMotorControl2(arm, joint, engine.VELOCITY_CONTROL, force=holding_n)

    def force_n(self, offset_m: float, speed_m_per_s: float) -> float:
        """Return the force along one axis that brings a finger back to its place.

        Args:
            offset_m: distance from where the gripper holds its root.
            speed_m_per_s: the same of its speed.
        """
        if not self.yields:
            return 0.0
        return -ROOT_STIFFNESS_N_PER_M * offset_m - ROOT_DAMPING_N_S_PER_M * speed_m_per_s
