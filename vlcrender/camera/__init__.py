"""Cameras: intrinsics, lens distortion and blur, rigs of several cameras, and regions of interest of their sensors.

Maps world points to pixels and pixels to rays. Nothing here knows about light, scenes or files.
"""
