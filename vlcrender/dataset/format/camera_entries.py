"""Models of the cameras and the sensor in dataset.json, with checks 4 to 6 of FORMAT.md."""

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from vlcrender.camera.distortion import Distortion
from vlcrender.camera.shutter import Shutter
from vlcrender.config.toml_model import Settings
from vlcrender.dataset.format.values import Electrons, Length, Matrix, Rotation, Share, Sigma, Spread, Triple


class CameraUncertainty(Settings):
    """Standard deviations of a camera's errors, as dataset.json states them."""

    parameters: tuple[Literal["focal", "aspect", "cx_px", "cy_px", "k1", "p1", "p2"], ...]
    device_sigma: tuple[Sigma, ...]
    shot_sigma: tuple[Sigma, ...]
    offset_sigma_m: Sigma
    rotation_sigma_deg: Sigma

    @model_validator(mode="after")
    def _has_one_of_each(self) -> Self:
        if len(set(self.parameters)) != len(self.parameters):
            raise ValueError("parameters have to be unique")
        if not len(self.parameters) == len(self.device_sigma) == len(self.shot_sigma):
            raise ValueError("device_sigma and shot_sigma need one number for each of parameters")
        return self


class CameraEntry(Settings):
    """A camera in dataset.json."""

    width_px: int
    height_px: int
    K: Matrix
    pixel_pitch_um: Length
    focal_length_mm: Length
    image_distance_mm: Length
    f_number: Length
    projection: Literal["perspective", "equidistant"]
    distortion: Distortion | None
    focus_distance_m: Length | Literal["infinity"] | None
    psf: Literal["none", "diffraction", "measured"]
    psf_wavelength_nm: Length
    psf_kernel: tuple[tuple[Share, ...], ...] | None
    shutter: Shutter
    R_cam_rig: Rotation
    offset_m: Triple
    uncertainty: CameraUncertainty | None

    @model_validator(mode="after")
    def _has_a_kernel_where_measured(self) -> Self:
        rows = self.psf_kernel
        if (rows is None) != (self.psf != "measured"):
            raise ValueError('psf_kernel has to be given with psf = "measured", and only then')
        if rows is not None:
            if len(rows) % 2 == 0 or len(rows) > 255 or any(len(row) != len(rows) for row in rows):
                raise ValueError("psf_kernel has to be square, with an odd number of rows of at most 255")
            if abs(sum(map(sum, rows)) - 1) > 1e-6:
                raise ValueError("psf_kernel has to have the sum 1")
        return self

    @model_validator(mode="after")
    def _fish_eye_has_no_distortion(self) -> Self:
        told = self.uncertainty
        if self.projection == "equidistant" and told is not None:
            sigmas = zip(told.parameters, told.device_sigma, told.shot_sigma, strict=False)
            if any(device or shot for name, device, shot in sigmas if name in ("k1", "p1", "p2")):
                raise ValueError('sigmas of k1, p1 and p2 have to be 0 with projection = "equidistant"')
        return self


class SensorEntry(Settings):
    """The sensor in dataset.json: parameters in effect at the ISO, temperature and noise mode of the frames."""

    bits: Annotated[int, Field(ge=1, le=32)]
    gain_e_per_dn: Electrons
    full_well_e: Electrons
    black_level_dn: Annotated[int, Field(ge=0)]
    noise: Literal["shot", "none", "full"]
    crosstalk: Share
    hot_pixel_share: Share
    hot_pixel_e_s: Spread
    prnu: Spread
    dark_current_e_s: Spread
    dsnu_e: Spread
    read_noise_e: Spread
    adc_noise_dn: Spread
    row_offset_e: Spread
    column_offset_e: Spread
    mosaic: Literal["none", "rggb", "bggr", "grbg", "gbrg"]

    @model_validator(mode="after")
    def _black_is_a_code(self) -> Self:
        if self.black_level_dn > 2**self.bits - 1:
            raise ValueError(f"black_level_dn = {self.black_level_dn}: {self.bits} bits end at {2**self.bits - 1}")
        return self
