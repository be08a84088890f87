"""Cameras: intrinsics, projections, poses, lens blur, rigs of several cameras, and regions of interest.

Maps world points to pixels and pixels to rays. Depends on neither light, scenes nor files.
"""
