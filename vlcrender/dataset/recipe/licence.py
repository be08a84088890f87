"""The licence of a dataset: an SPDX expression."""

from typing import Annotated

from packaging.licenses import InvalidLicenseExpression, canonicalize_license_expression
from pydantic import AfterValidator


def _spdx(text: str) -> str:
    """The expression as SPDX spells it. Raises ValueError for an unknown identifier."""
    try:
        return canonicalize_license_expression(text)
    except InvalidLicenseExpression:
        raise ValueError(
            'must be an SPDX expression: an identifier of https://spdx.org/licenses, such as "CC-BY-4.0"'
        ) from None


Licence = Annotated[str, AfterValidator(_spdx)]
