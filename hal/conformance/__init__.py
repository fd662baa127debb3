"""Requirements on every device kind as pytest classes: a backend's tests subclass the contract and supply a `rig`.

```python
class TestMyScanner(RangeScannerContract):
    @pytest.fixture
    def rig(self) -> Iterator[Rig[RangeScanner]]:
        with my_emulator() as far_side, connect(...) as device:
            yield Rig(device=device, clock=WallClock(), inject=far_side.inject)
```

Each test has a level: *static* (needs no communication), *connect*, *read* or *motion* (something moves or switches).
"""

from typing import Any

from hal.conformance.acting import ArmContract, GripperContract, LightsContract
from hal.conformance.device import DeviceContract
from hal.conformance.rig import LEVELS, Level, Rig
from hal.conformance.sensing import (
    CameraContract,
    ForceTorqueContract,
    ProximityContract,
    RangeScannerContract,
    TouchContract,
)
from hal.devices import DeviceKind

CONTRACTS: dict[DeviceKind, type[DeviceContract[Any]]] = {
    contract.kind: contract
    for contract in (
        ArmContract,
        GripperContract,
        CameraContract,
        RangeScannerContract,
        ProximityContract,
        TouchContract,
        ForceTorqueContract,
        LightsContract,
    )
}

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
