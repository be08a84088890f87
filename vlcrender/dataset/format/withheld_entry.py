"""What dataset.json says of a truth that is withheld."""

from typing import Literal

from vlcrender.config.toml_model import Settings


class Withheld(Settings):
    """The sealed file, and the frames whose truth it alone has."""

    sha256: str
    """Digest of truth.sealed, 64 hex digits."""
    frames: Literal["all"] | tuple[int, ...]
    """Frames without a row in truth.parquet; with "all" there is no such file."""

    def frames_with_truth(self, count: int) -> list[int]:
        """Frames of a set of `count` frames that truth.parquet has a row of."""
        withheld = set(range(count) if self.frames == "all" else self.frames)
        return [frame for frame in range(count) if frame not in withheld]
