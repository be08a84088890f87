"""Estimation of camera positions from images of ceiling LEDs, and scores of the estimates.

A dataset is a folder in the format of datasets/FORMAT.md. Errors of input raise InputError, frames without a position
EstimationFailure. Submodules are loaded on first use; `import estimator` loads none of them.

    import estimator as est

    dataset = est.read_dataset("out/quickstart")
    answer = est.estimate(est.read_frame(dataset, 0), "ml")
    est.run("out/quickstart", ["ml", "gravity-fit"])
    scores = est.score("out/quickstart").to_pandas()
    by_tilt = est.table("out/quickstart", x=["tilt_deg"], statistics=["median", "p95"]).to_pandas()
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from estimator.errors import EstimationFailure, InputError
    from estimator.evaluate.run import run
    from estimator.evaluate.score import Scores, score
    from estimator.evaluate.table import Table, table
    from estimator.io.dataset import Dataset, read_dataset, read_frame
    from estimator.io.device import DeviceFrame, frame
    from estimator.methods.registry import estimate, estimate_device, variants
    from estimator.methods.variant import DeviceMethod, Estimate, Needs, Variant
    from estimator.receiver.receive import receive_frames

    __version__: str

__all__ = [
    "Dataset",
    "DeviceFrame",
    "DeviceMethod",
    "Estimate",
    "EstimationFailure",
    "InputError",
    "Needs",
    "Scores",
    "Table",
    "Variant",
    "__version__",
    "estimate",
    "estimate_device",
    "frame",
    "read_dataset",
    "read_frame",
    "receive_frames",
    "run",
    "score",
    "table",
    "variants",
]

_MODULES = {
    "Dataset": "estimator.io.dataset",
    "DeviceFrame": "estimator.io.device",
    "DeviceMethod": "estimator.methods.variant",
    "Estimate": "estimator.methods.variant",
    "EstimationFailure": "estimator.errors",
    "InputError": "estimator.errors",
    "Needs": "estimator.methods.variant",
    "Scores": "estimator.evaluate.score",
    "Table": "estimator.evaluate.table",
    "Variant": "estimator.methods.variant",
    "estimate": "estimator.methods.registry",
    "estimate_device": "estimator.methods.registry",
    "frame": "estimator.io.device",
    "read_dataset": "estimator.io.dataset",
    "read_frame": "estimator.io.dataset",
    "receive_frames": "estimator.receiver.receive",
    "run": "estimator.evaluate.run",
    "score": "estimator.evaluate.score",
    "table": "estimator.evaluate.table",
    "variants": "estimator.methods.registry",
}


def __getattr__(name: str) -> object:
    """Load a public name on first use."""
    if name == "__version__":
        from importlib.metadata import version

        value: object = version("vlcrender")
    elif name in _MODULES:
        value = getattr(import_module(_MODULES[name]), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Public names."""
    return sorted(__all__)
