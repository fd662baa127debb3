"""The nine local pose functions, which measure how badly a pose fits a measurement (paper eqs 10-13).

`exact` computes them without approximation, `rows` as whitened residuals of first order for quick descents.
`benchmarks.fusion_reference` is a slow, simple and independent implementation for checks.
"""

from fusion.distance.local_functions import local_value, local_values, local_values_and_gradients

__all__ = ["local_value", "local_values", "local_values_and_gradients"]
