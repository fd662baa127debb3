"""`python -m benchmarks.drivers [--seconds S] [--only PART,...]`; each line: what, pass line, measured, PASS or FAIL."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable

from benchmarks.drivers.cameras import part_cameras
from benchmarks.drivers.canbus import part_can
from benchmarks.drivers.damaged import part_damaged
from benchmarks.drivers.faults import part_faults
from benchmarks.drivers.fuzz import part_fuzz
from benchmarks.drivers.life import part_isolation, part_reconnect
from benchmarks.drivers.modbus import part_modbus
from benchmarks.drivers.motion import part_csp, part_kill, part_ur
from benchmarks.drivers.peers import part_peers
from benchmarks.drivers.sessions import part_sessions
from benchmarks.drivers.stamps import part_stamps
from benchmarks.drivers.swap import part_swap
from benchmarks.drivers.wire import part_decode, part_latency
from hal.gc_freeze import freeze_loaded
from service.processes.cell import SWITCH_S

PARTS: dict[str, Callable[[float], None]] = {
    "latency": part_latency,
    "modbus": part_modbus,
    "decode": part_decode,
    "can": part_can,
    "stamps": part_stamps,
    "reconnect": part_reconnect,
    "sessions": part_sessions,
    "peers": part_peers,
    "swap": part_swap,
    "isolation": part_isolation,
    "ur": part_ur,
    "csp": part_csp,
    "kill": part_kill,
    "fuzz": part_fuzz,
    "damaged": part_damaged,
    "faults": part_faults,
    "cameras": part_cameras,
}


def main() -> None:
    """Run the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="for each cell and figure")
    parser.add_argument("--only", default=",".join(PARTS), help="comma list of parts")
    arguments = parser.parse_args()
    sys.setswitchinterval(SWITCH_S)  # both as in the cell process
    freeze_loaded()
    print(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores; {arguments.seconds:.0f} s a figure")
    for name in arguments.only.split(","):
        if name not in PARTS:
            sys.exit(f"unknown part {name!r}; there are: {', '.join(PARTS)}")
        PARTS[name](arguments.seconds)


if __name__ == "__main__":
    main()
