"""The promises of every device kind as pytest classes; a backend subclasses its kind's contract and supplies a `rig`.

```python
class TestMyScanner(RangeScannerContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[RangeScanner]]:
        with my_emulator() as far_side, connect(...) as device:
            yield Rig(device=device, clock=WallClock(), inject=far_side.inject)
```

Levels: *static* (what can be said without the wire), *connect*, *read*, *motion* (things move or switch).
"""

from hal.conformance.contracts import (
    CONTRACTS,
    ArmContract,
    CameraContract,
    ForceTorqueContract,
    GripperContract,
    LightsContract,
    ProximityContract,
    RangeScannerContract,
    TouchContract,
)
from hal.conformance.rig import LEVELS, Level, Rig

__all__ = [
    "CONTRACTS",
    "LEVELS",
    "ArmContract",
    "CameraContract",
    "ForceTorqueContract",
    "GripperContract",
    "Level",
    "LightsContract",
    "ProximityContract",
    "RangeScannerContract",
    "Rig",
    "TouchContract",
]
