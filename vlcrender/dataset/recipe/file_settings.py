"""Settings of a dataset's files: the format of frames, the number of previews, and how many frames a file holds."""

from typing import Annotated, Literal

from pydantic import Field

from vlcrender.config.toml_model import Settings

FrameFormat = Literal["exr-uint32", "exr-float32", "png16"]
"""EXR with 32-bit integers; EXR with 32-bit floats, exact below 2^24; grey PNG with 16 bits, full frames alone."""
BITS = {"exr-uint32": 32, "exr-float32": 24, "png16": 16}
"""Bits of the largest digital number that each format holds exactly."""


class FilesEntry(Settings):
    """What dataset.json states of the files."""

    format: FrameFormat = "exr-uint32"
    """Format of `frames/`."""


class FileSettings(FilesEntry):
    """Settings of the dataset's files."""

    previews: Annotated[int, Field(ge=0)] | None = None
    """Number of frames, the first ones, that have a preview; every frame where not given."""
    frames_per_file: Annotated[int, Field(ge=1, le=100_000)] = 1
    """Frames whose regions share a file, a shard; more than 1 needs `regions`. An interrupted shard is made anew."""

    def has_preview(self, frame: int) -> bool:
        """Whether a frame has a preview."""
        return self.previews is None or frame < self.previews

    def problem(self, bits: int, has_regions: bool) -> str | None:
        """Why the files cannot hold frames of so many bits, of regions or whole; None where they can."""
        if bits > BITS[self.format]:
            return (
                f'files.format = "{self.format}": holds numbers of {BITS[self.format]} bits, but sensor.bits = {bits}; '
                'choose "exr-uint32" or fewer bits'
            )
        if self.format == "png16" and has_regions:
            return 'files.format = "png16": holds full frames alone; remove [regions] or choose an EXR format'
        if self.frames_per_file > 1 and not has_regions:
            return (
                f"files.frames_per_file = {self.frames_per_file}: files of several frames hold regions; add "
                "[regions] or remove frames_per_file"
            )
        return None
