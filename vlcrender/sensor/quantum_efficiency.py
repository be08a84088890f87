"""Quantum efficiency as a table: electrons per photon over wavelength, of all pixels or of a mosaic's colours."""

import json
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field, ValidationError, model_validator

from vlcrender.config.toml_model import Settings

Share = Annotated[float, Field(ge=0, le=1)]
Curve = Annotated[tuple[Share, ...], Field(min_length=2, max_length=2000)]
COLOURS = ("red", "green", "blue")


class QuantumEfficiency(Settings):
    """Electrons per photon at the given wavelengths: `values` for all pixels, or one curve for each colour of a mosaic.

    Linear between the wavelengths, 0 outside.
    """

    wavelengths_nm: Annotated[
        tuple[Annotated[float, Field(ge=100, le=2000)], ...], Field(min_length=2, max_length=2000)
    ]
    """Wavelengths of the curves, nanometres, increasing."""
    values: Curve | None = None
    """Electrons per photon of every pixel; without a mosaic."""
    red: Curve | None = None
    """Electrons per photon of the red pixels of a mosaic."""
    green: Curve | None = None
    """Electrons per photon of the green pixels of a mosaic."""
    blue: Curve | None = None
    """Electrons per photon of the blue pixels of a mosaic."""

    @model_validator(mode="after")
    def _curves_fit_the_wavelengths(self) -> Self:
        if any(np.diff(self.wavelengths_nm) <= 0):
            raise ValueError("wavelengths_nm: must increase")
        given = [name for name in ("values", *COLOURS) if getattr(self, name) is not None]
        if given not in (["values"], list(COLOURS)):
            raise ValueError("give either values, or red, green and blue")
        for name in given:
            if len(getattr(self, name)) != len(self.wavelengths_nm):
                raise ValueError(
                    f"{name}: has {len(getattr(self, name))} numbers for {len(self.wavelengths_nm)} wavelengths_nm"
                )
        return self

    @property
    def coloured(self) -> bool:
        """Whether the table has one curve for each colour of a mosaic."""
        return self.values is None

    def at(self, wavelengths_nm: NDArray[np.float64], colour: str = "values") -> NDArray[np.float64]:
        """Electrons per photon, same shape as the wavelengths. `colour` names a curve: "values" without a mosaic."""
        table = getattr(self, colour)
        interpolated: NDArray[np.float64] = np.interp(wavelengths_nm, self.wavelengths_nm, table, left=0.0, right=0.0)
        return interpolated


def _silicon_or_table(value: Any) -> Any:
    if isinstance(value, dict):
        try:
            return QuantumEfficiency.model_validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            # the errors of a union name Python types, which a TOML file does not have
            problem = error.errors(include_url=False)[0]
            place = "".join(f"[{p}]" if isinstance(p, int) else str(p) for p in problem["loc"])
            message = problem["msg"].removeprefix("Value error, ")
            raise ValueError(f"{place} = {json.dumps(problem['input'])}: {message}" if place else message) from None
    if value != "silicon" and not isinstance(value, QuantumEfficiency):
        raise ValueError('must be "silicon", or a table of wavelengths_nm and values (or red, green and blue)')
    return value


SiliconOrTable = Annotated[Literal["silicon"] | QuantumEfficiency, BeforeValidator(_silicon_or_table)]
"""Values of a sensor's key `quantum_efficiency`: "silicon" is `radiometry.Silicon`."""
