"""V-P4L: Bai, "Novel visible light communication assisted perspective-four-line algorithm for indoor localization",
arXiv 2009.12320, 2020: the pose of one rectangular luminaire from the planes of its edges.

Published, as far as known from its abstract: a single rectangular luminaire; plane and solid geometry give its
orientation and its place in camera axes; with the coordinates that light tells, single-view geometry and linear least
squares give position and attitude of the camera, without correspondences of features; a correction for LEDs at
different heights; errors below 15 cm and 3 deg in simulation.

Chosen here: the luminaire is a square LED, the one with the longest contour; its LED has one height and needs no
correction. The four edges are lines through the points of the contour nearest to the sides of their hull. Each spans a
plane with the projection centre; the planes of two opposite sides meet in the direction of these sides, and the two
directions are made perpendicular. The centre follows from the planes and the side by linear least squares. A square
looks the same after a quarter turn: the spots of the other LEDs decide which of four yaws is right, so a second LED is
needed.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from estimator.camera.pose import Pose
from estimator.camera.undistort import pinhole_image
from estimator.errors import EstimationFailure
from estimator.io.device import DeviceFrame
from estimator.methods.variant import Estimate, Needs, Variant
from estimator.solvers.cones import fit_plane
from estimator.spots.contours import find_contours
from estimator.spots.correspondences import centroids_px, find_correspondences, led_positions_m

Floats = NDArray[np.float64]

# Share of a side at each of its ends whose points may belong to the next side.
CORNER_SHARE = 0.1
# Half of them, the share that outliers leave at least, determine a plane.
MIN_SIDE_POINTS = 6
# Tolerance of the hull's four sides, in shares of its circumference, from the smallest one on.
HULL_TOLERANCES = np.geomspace(0.005, 0.1, 14)
QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def v_p4l(frame: DeviceFrame) -> Estimate:
    """Position from the edges of a square LED; raises EstimationFailure."""
    square = max(find_contours(frame, "square"), key=lambda one: len(one.image))
    others = [one for one in find_correspondences(frame) if one.led.id != square.led.id]
    if not others:
        raise EstimationFailure("position", "LEDs identified: 1, needed: 2, because a square has four yaws")
    centre_m = np.array(square.led.position_m)
    image = pinhole_image(centroids_px(others), frame.camera)
    sides = sides_of(square.image)
    pose = pose_from_sides(sides, centre_m, square.led.half_width_m, led_positions_m(others), image)
    return Estimate(pose.position_m)


def sides_of(contour: Floats) -> list[Floats]:
    """Points (n, 2) of each of the four sides of a quadrilateral, in order around it, from its contour (n, 2).

    Raises EstimationFailure if it has not four sides.
    """
    # OpenCV's points are of single precision, which decides nothing but the side that a point belongs to.
    hull = cv2.convexHull(((contour - contour.mean(axis=0)) / contour.std()).astype(np.float32))
    around = cv2.arcLength(hull, True)
    shapes = (cv2.approxPolyDP(hull, float(share) * around, True)[:, 0] for share in HULL_TOLERANCES)
    corners = next((shape for shape in shapes if len(shape) == 4), None)
    if corners is None:
        raise EstimationFailure("contour", "the outline of a square LED has not four sides")
    starts = corners.astype(np.float64) * contour.std() + contour.mean(axis=0)
    along = np.roll(starts, -1, axis=0) - starts
    offsets = contour[:, None] - starts
    shares = (offsets * along).sum(axis=2) / (along**2).sum(axis=1)
    across = np.abs(offsets[..., 0] * along[:, 1] - offsets[..., 1] * along[:, 0]) / np.linalg.norm(along, axis=1)
    nearest = np.where((shares > 0) & (shares < 1), across, np.inf).argmin(axis=1)
    inner = (np.abs(shares - 0.5) < 0.5 - CORNER_SHARE)[np.arange(len(contour)), nearest]
    sides = [contour[inner & (nearest == k)] for k in range(4)]
    if min(len(side) for side in sides) < MIN_SIDE_POINTS:
        raise EstimationFailure("contour", "the outline of a square LED has not four sides")
    return sides


def pose_from_sides(sides: list[Floats], centre_m: Floats, half_m: float, others_m: Floats, image: Floats) -> Pose:
    """Pose from points (n, 2) at unit depth on the four sides, in order, of a square of half side `half_m`.

    `centre_m` (3,) is its centre in the world. Spots `image` (n, 2) of the LEDs `others_m` (n, 3) decide between four
    yaws. Raises EstimationFailure.
    """
    planes = np.array([fit_plane(side) for side in sides])
    first, second = np.cross(planes[0], planes[2]), np.cross(planes[1], planes[3])
    axes = np.column_stack([first / np.linalg.norm(first), second / np.linalg.norm(second)])
    # The nearest pair of perpendicular directions.
    left, _, right = np.linalg.svd(axes, full_matrices=False)
    x, y = (left @ right).T
    middles = np.array([[*side.mean(axis=0), 1.0] for side in sides])
    ahead = middles.mean(axis=0)
    up = np.cross(x, y)
    up *= np.sign(up @ ahead)
    # Vectors from the square's centre to the middles of its sides: sides 0 and 2 are along x, 1 and 3 along y.
    outward = np.array([y, x, y, x])
    outward *= np.sign(((middles - ahead) * outward).sum(axis=1))[:, None]
    vector_m = np.linalg.lstsq(planes, -half_m * (planes * outward).sum(axis=1))[0]
    if vector_m[2] <= 0:
        raise EstimationFailure("position", "the planes of the edges meet behind the camera")
    R_cam_world = np.column_stack([x, np.cross(up, x), up])
    best, min_error = None, np.inf
    for _ in range(4):
        R_cam_world = R_cam_world @ QUARTER_TURN
        pose = Pose(centre_m - R_cam_world.T @ vector_m, R_cam_world)
        p_cam = pose.in_camera(others_m)
        error = np.linalg.norm(p_cam[:, :2] / p_cam[:, 2:] - image) if (p_cam[:, 2] > 0).all() else np.inf
        if error < min_error:
            best, min_error = pose, float(error)
    if best is None:
        raise EstimationFailure("position", "no pose has the other LEDs in front of the camera")
    return best


V_P4L = Variant(
    "v-p4l",
    "Bai 2020: planes through a square LED's four edges, their intersections, linear position",
    v_p4l,
    needs=Needs(2, faces="square", sizes=True),
)
