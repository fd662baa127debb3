"""URScript program that follows RTDE input registers: a heartbeat and one register a joint."""

from __future__ import annotations

JOINTS = 6
FIRST_REGISTER = 24  # 0-23 are reserved for fieldbuses
RAD_PER_COUNT = 1e-6
CONTROL_RATE_HZ = 500  # of the controller, whatever the RTDE rate
FIRST_SET_POINT_S = 1.0  # the program ends if no set-point comes in this time
FAR_BEATS, BEATS = 100_000, 2**30  # a register further ahead than this holds another session's heartbeat


def servo_program(*, first_beat: int, watchdog_s: float, lookahead_s: float, gain: int, brake_rad_per_s2: float) -> str:
    """Return the URScript program that follows the registers and brakes when the heartbeat stops.

    Args:
        first_beat: the heartbeat before the first set-point. The registers may still hold an older session's set-point,
            so the program waits for a heartbeat just above this one, for at most `FIRST_SET_POINT_S`. A set-point that is
            sent before the program runs counts, and so does the silence after it.
    """
    cycles, patience = (round(s * CONTROL_RATE_HZ) for s in (watchdog_s, FIRST_SET_POINT_S))
    joints = ", ".join(f"read_input_integer_register({FIRST_REGISTER + 1 + i})*{RAD_PER_COUNT}" for i in range(JOINTS))
    beat = f"read_input_integer_register({FIRST_REGISTER})"
    return (
        "def panelwright_servo():\n"
        f"  first = {first_beat}\n"
        f"  last = {beat}\n"
        "  waited = 0\n"
        f"  while (last <= first or last > first + {FAR_BEATS}) and waited < {patience}:\n"
        "    waited = waited + 1\n"
        "    sync()\n"
        f"    last = {beat}\n"
        "  end\n"
        "  silent = 0\n"
        f"  if waited >= {patience}:\n    silent = {cycles}\n  end\n"
        f"  while silent < {cycles}:\n"
        f"    beat = {beat}\n"
        "    if beat == last:\n      silent = silent + 1\n    else:\n      silent = 0\n    end\n"
        "    last = beat\n"
        f"    servoj([{joints}], t=0.002, lookahead_time={lookahead_s}, gain={gain})\n"
        "  end\n"
        f"  stopj({brake_rad_per_s2})\n"
        "end\n"
    )
