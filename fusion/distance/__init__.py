"""How badly a pose fits a measurement: the nine local pose functions (paper eqs 10-13).

`exact` has them without approximation, `rows` as whitened residuals of first order for quick descents; `reference` is slow,
plain and independent of both, to check them by.
"""

from fusion.distance.local_functions import local_value, local_values, local_values_and_gradients

__all__ = ["local_value", "local_values", "local_values_and_gradients"]
