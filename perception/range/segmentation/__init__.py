"""Segmentation of a depth image: grow planes from a grid of blocks, select surface kinds, then assign border pixels.

Most kernels share these arguments: `depth` (H, W) in metres, NaN where there is no reading; `sen` or `packed` (5,), the
sensor as `RangeSensorModel.packed`; `noise` or `law` (6,), the noise as `NoiseModel.packed`; `perspective`, true for a
pinhole sensor. A surface has a `kind` and parameters `th` (16,), which `fitting.surfaces` lists; `kinds` and `ths` (or
`table`) hold those of several surfaces. Ray coordinates x, y are on the plane z = 1 (pinhole) or in metres
(orthographic). A residual in sigmas is divided by the standard deviation of the depth.
"""
