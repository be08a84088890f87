"""The identity of this program: a digest of its source and of the libraries that make frames."""

import hashlib
from functools import cache
from importlib.metadata import version
from pathlib import Path

PACKAGE = Path(__file__).parent.parent
LIBRARIES = ("mitsuba", "drjit", "numpy", "OpenEXR")
"""Packages whose versions are a part of the digest."""


@cache
def program_sha256() -> str:
    """SHA-256 over the Python files of vlcrender, in the order of their names, and the versions of LIBRARIES.

    64 hex digits; taken once in a process.
    """
    digest = hashlib.sha256(repr([(name, version(name)) for name in LIBRARIES]).encode())
    for path in sorted(PACKAGE.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {len(content)}\n".encode() + content)
    return digest.hexdigest()
