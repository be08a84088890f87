"""Cameras whose numbers are data of a kernel, not part of its text.

Dr.Jit puts the Python numbers of a computation into the kernel as literals and compiles a kernel for each combination.
A camera that is the same in all frames needs one kernel; where each frame has a camera of its own, each frame would
compile its own kernels.
"""

from typing import Any, Self

from pydantic import PrivateAttr

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.intrinsics import Camera
from vlcrender.camera.projection import Perspective, Projection
from vlcrender.core.backend import dr


class CameraData(Camera):
    """A camera for Dr.Jit arrays of one type; `sensor_position` and `unproject` give the camera's values."""

    _number: Any = PrivateAttr()
    """The type of the arrays, mi.Float or mi.Float64."""

    @classmethod
    def of(cls, camera: Camera, number: Any) -> Self:
        """The camera for arrays of the type `number`."""
        data = cls.model_construct(**dict(camera))
        data._number = number
        return data

    def inverse_matrix(self) -> list[list[Any]]:
        """K^-1 as data."""
        return [[dr.opaque(self._number, entry) for entry in row] for row in super().inverse_matrix()]

    @property
    def lens_projection(self) -> Projection:
        """The lens with its distortion as data."""
        if self.distortion is None:
            return super().lens_projection
        coefficients = {name: dr.opaque(self._number, value) for name, value in self.distortion}
        return Perspective(Distortion.model_construct(**coefficients))
