"""TUM trajectories: `timestamp tx ty tz qx qy qz qw`, the camera in the world, metres, one file a camera.

Source: TUM RGB-D benchmark, File Formats. The quaternion is that of R_cam_world transposed, scalar last; the camera's
axes are x right, y down, z forward.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from vlcrender.export.conventions import quaternion_xyzw, text
from vlcrender.export.source import Source

TIMES = {
    True: "middle of the frame on the rig's clock, s",
    False: "number of the shot, s: the set has no clock",
}


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write CAMERA.txt for each camera."""
    for name in source.dataset.cameras:
        lines = [
            f"# {source.dataset.name}, camera {name}, true poses",
            f"# timestamp tx ty tz qx qy qz qw; timestamp: {TIMES[source.has_clock]}",
        ]
        for row, truth in source.posed_frames:
            if row.camera == name:
                world_cam = np.reshape(truth.R_cam_world, (3, 3)).T
                pose = text([*truth.position_m, *quaternion_xyzw(world_cam)])
                lines.append(f"{source.time_s(row):.9f} {pose}")
        (out / f"{name}.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return {"time": TIMES[source.has_clock]}
