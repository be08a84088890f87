"""Settings of a dataset's files: how many previews there are, and how many frames a file holds."""

from typing import Annotated

from pydantic import Field

from vlcrender.config.toml_model import Settings


class FileSettings(Settings):
    """Settings of the dataset's files."""

    previews: Annotated[int, Field(ge=0)] | None = None
    """Number of frames, the first ones, that have a preview; every frame where not given."""
    frames_per_file: Annotated[int, Field(ge=1, le=100_000)] = 1
    """Frames whose regions share a file, a shard; more than 1 needs `regions`. An interrupted shard is made anew."""

    def has_preview(self, frame: int) -> bool:
        """Whether a frame has a preview."""
        return self.previews is None or frame < self.previews
