"""Camera geometry as the device knows it: pose, projection, undistortion, and leveling by gravity.

It is written independently of the renderer's: an error shared by both packages would cancel and stay hidden.
"""
