"""Reads the units that are printed on drawn gauges: `python -m benchmarks.gauge_units [SEED [COUNT]]`.

Told the ends of the scale, so that most gauges are read. The unit is as large as the numerals, where the face is barest;
the pointer, a shadow or a reflection may cover it. The exit code is 1 if a wrong unit is told.
"""

from __future__ import annotations

import sys
from dataclasses import replace

from benchmarks.photographs import FACE_SHARE, LEGIBLE_PX, printed_way
from benchmarks.vision_manometers import draw_manometer
from perception.vision import read_photograph

UNITS = ("bar", "bar", "psi", "kPa", "MPa", "mbar", "kg/cm2", "l/min")
SEED, COUNT = 992000, 80


def main(arguments: list[str]) -> int:
    """Print of how many gauges the unit is right, and of how many it is wrong."""
    first = int(arguments[0]) if arguments else SEED
    count = int(arguments[1]) if len(arguments) > 1 else COUNT
    right = wrong = answers = 0
    for seed in range(first, first + count):
        unit = UNITS[seed % len(UNITS)]
        way = replace(printed_way(seed), unit=unit)
        drawn = draw_manometer(seed, way)
        if way.print is None or way.print.height * FACE_SHARE * min(drawn.image.shape[:2]) < LEGIBLE_PX:
            continue
        ends_rad = (way.angle_rad(0.0), way.angle_rad(1.0))
        found = read_photograph(drawn.image, "gauge", scale=(0.0, drawn.full), ends_rad=ends_rad)
        answers += found.answered
        right += found.unit == unit
        wrong += found.unit not in ("", unit)
    print(f"units of gauges that are answered: {right} of {answers} right, {wrong} wrong")
    return int(wrong > 0)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
