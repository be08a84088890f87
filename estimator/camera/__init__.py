"""Camera geometry as the device knows it: projection, undistortion, and leveling by gravity.

Written apart from the renderer's on purpose: an error shared by both would cancel and never show.
"""
