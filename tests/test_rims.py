"""Points of an LED's rim next to a point of its plane, against a search over a fine polygon."""

import numpy as np
import pytest

from vlcrender.core.planar_shapes import Disc, Rectangle


@pytest.mark.parametrize("shape", [Disc(0.3), Rectangle((0.6, 0.4)), Rectangle((0.2, 0.5), 20.0)], ids=repr)
def test_no_point_of_the_rim_is_nearer(shape: Disc | Rectangle) -> None:
    """The rim's polygon has a point within half a step of the nearest one: its distance is larger by that at most."""
    points = np.random.default_rng(2).uniform(-0.6, 0.6, (400, 2))
    nearest = np.stack(shape.nearest_on_rim(*points.T), axis=1)
    rim = shape.rim(4000)
    step = np.linalg.norm(np.diff(rim, axis=0), axis=1).max()
    distances = np.linalg.norm(points[:, None] - rim, axis=2).min(axis=1)
    found = np.linalg.norm(points - nearest, axis=1)
    assert (np.linalg.norm(nearest[:, None] - rim, axis=2).min(axis=1) <= step).all()
    assert (found <= distances + 1e-12).all()
    assert (distances <= found + step / 2 + 1e-12).all()
