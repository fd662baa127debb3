"""Segmentation of a depth image: grow planes from a grid of blocks, select surface kinds, then assign border pixels."""
