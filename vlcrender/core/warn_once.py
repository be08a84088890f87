"""Log warnings once per run."""

import logging
import multiprocessing
from functools import cache


@cache
def warn_once(logger: logging.Logger, message: str) -> None:
    """Log a warning, unless this process has logged it before or is a worker, whose parent has logged it."""
    if multiprocessing.parent_process() is None:
        logger.warning("%s", message)
