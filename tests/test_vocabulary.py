"""One vocabulary: words that the field does not use for a thing stand in no code, document or message."""

import re
import subprocess

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


@pytest.mark.parametrize(("retired", "used"), RETIRED.items(), ids=RETIRED.values())
def test_retired_words_are_not_used(retired: str, used: str) -> None:
    """`used` is the field's word."""
    listed = subprocess.run(["git", "ls-files", *TEXT], cwd=ROOT, capture_output=True, text=True, check=True)
    places = []
    for name in listed.stdout.splitlines():
        if name == "tests/test_vocabulary.py" or not (ROOT / name).is_file():
            continue
        for number, line in enumerate((ROOT / name).read_text(encoding="utf-8").splitlines(), start=1):
            found = re.search(rf"(?<![A-Za-z_.])({retired})(?![A-Za-z_.(=\]])", line)
            found = found or re.search(rf"(?<![a-z_.])({retired})(?![a-z_.(=\]])", line.lower())
            if found:
                places.append(f"{name}:{number}: {found[0]} -> {used}: {line.strip()[:100]}")
    assert not places, "\n".join(places)
