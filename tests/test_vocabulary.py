"""One vocabulary: words that the field does not use for a thing stand in no code, document or message."""

import re
import subprocess
from functools import cache

import pytest
from conftest import ROOT

RETIRED = {
    r"false images?": "specular reflection",
    r"surrounds?|surrounding light|other light": "ambient",
    r"(LED|pixel|overscan) windows?|LedWindows": "region of interest",
    r"(window )?panes?": "glazing",
    r"(diffusing|translucent|lit) sheets?": "diffuser",
    r"converters?": "ADC",
    r"sightings?": "correspondence",
    r"believed": "inliers",
    r"mates": "other cameras",
    r"straightened": "corrected for eccentricity",
    r"(MOST|LEAST|FEWEST|LONGEST)_[A-Z_]+": "MAX_, MIN_",
    r"nobody('s)?|somebody('s)?|whoever|as it comes|no further off": "the noun",
}
TEXT = ("*.py", "*.md", "*.toml", "*.cff", "Makefile")


@cache
def texts() -> dict[str, str]:
    """Of every file of the checkout but this one, by its name."""
    listed = subprocess.run(["git", "ls-files", *TEXT], cwd=ROOT, capture_output=True, text=True, check=True)
    names = [name for name in listed.stdout.splitlines() if name != "tests/test_vocabulary.py"]
    return {name: (ROOT / name).read_text(encoding="utf-8") for name in names if (ROOT / name).is_file()}


@pytest.mark.parametrize(("retired", "used"), RETIRED.items(), ids=RETIRED.values())
def test_retired_words_are_not_used(retired: str, used: str) -> None:
    """`used` is the field's word."""
    as_written = re.compile(rf"(?<![A-Za-z_.])({retired})(?![A-Za-z_.(=\]])")
    in_lower_case = re.compile(rf"(?<![a-z_.])({retired})(?![a-z_.(=\]])")
    places = []
    for name, text in texts().items():
        for found in (*as_written.finditer(text), *in_lower_case.finditer(text.lower())):
            number = text.count("\n", 0, found.start())
            places.append(f"{name}:{number + 1}: {found[0]} -> {used}: {text.splitlines()[number].strip()[:100]}")
    assert not places, "\n".join(places)
