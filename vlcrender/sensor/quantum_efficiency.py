"""Quantum efficiency as a table: electrons a photon by wavelength, of one kind of pixel or of a mosaic's three."""

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
    """Electrons a photon at some wavelengths: `values` of all pixels, or those under each colour of a mosaic.

    Linear in between, 0 outside.
    """

    wavelengths_nm: Annotated[
        tuple[Annotated[float, Field(ge=100, le=2000)], ...], Field(min_length=2, max_length=2000)
    ]
    values: Curve | None = None
    red: Curve | None = None
    green: Curve | None = None
    blue: Curve | None = None

    @model_validator(mode="after")
    def _curves_fit_the_wavelengths(self) -> Self:
        if any(np.diff(self.wavelengths_nm) <= 0):
            raise ValueError("wavelengths_nm: have to increase")
        given = [name for name in ("values", *COLOURS) if getattr(self, name) is not None]
        if given not in (["values"], list(COLOURS)):
            raise ValueError("needs values, or red, green and blue, and not both")
        for name in given:
            if len(getattr(self, name)) != len(self.wavelengths_nm):
                raise ValueError(
                    f"{name}: has {len(getattr(self, name))} numbers for {len(self.wavelengths_nm)} wavelengths_nm"
                )
        return self

    @property
    def coloured(self) -> bool:
        """Whether it is that of a mosaic."""
        return self.values is None

    def at(self, wavelengths_nm: NDArray[np.float64], colour: str = "values") -> NDArray[np.float64]:
        """Electrons a photon, same shape as the wavelengths. `colour`: red, green or blue; "values" of no mosaic."""
        table = getattr(self, colour)
        interpolated: NDArray[np.float64] = np.interp(wavelengths_nm, self.wavelengths_nm, table, left=0.0, right=0.0)
        return interpolated


def _silicon_or_table(value: Any) -> Any:
    if isinstance(value, dict):
        try:
            return QuantumEfficiency.model_validate_json(json.dumps(value), strict=True)
        except ValidationError as error:
            # a union's own errors name its members, of which a TOML file knows nothing
            problem = error.errors(include_url=False)[0]
            place = "".join(f"[{p}]" if isinstance(p, int) else str(p) for p in problem["loc"])
            message = problem["msg"].removeprefix("Value error, ")
            raise ValueError(f"{place} = {json.dumps(problem['input'])}: {message}" if place else message) from None
    if value != "silicon" and not isinstance(value, QuantumEfficiency):
        raise ValueError('has to be "silicon", or a table of wavelengths_nm and values (or red, green and blue)')
    return value


SiliconOrTable = Annotated[Literal["silicon"] | QuantumEfficiency, BeforeValidator(_silicon_or_table)]
"""What a sensor's `quantum_efficiency` may be: "silicon" is `photometry.Silicon`."""
