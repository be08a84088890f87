"""Scores of scores.json where they are current."""

from pathlib import Path

from pydantic import BaseModel, Field, ValidationError

from estimator.errors import InputError
from estimator.evaluate.known import estimate_paths
from estimator.evaluate.score import VERSION, Scores, score
from estimator.evaluate.sources import sources_of
from estimator.io.records import first_problem


class _Header(BaseModel):
    version: int
    sources: dict[str, str] = Field(default_factory=dict)


def read_or_score(folder: Path) -> Scores:
    """Scores of scores.json if it is made of the truth and estimates that are there, by their digests, else new scores.

    The truth may be missing if scores.json is there, and so may all estimates. Scores of an older version are computed
    again. Raises InputError.
    """
    path, estimates = folder / "scores.json", estimate_paths(folder)
    if not path.exists():
        return score(folder)
    content = path.read_bytes()
    try:
        header = _Header.model_validate_json(content)
        if header.version < VERSION or not sources_of(folder, estimates).items() <= header.sources.items():
            return score(folder)
        scores = Scores.model_validate_json(content)
    except ValidationError as error:
        raise InputError(f"{path}: {first_problem(error)}") from None
    if estimates and [one.variant for one in scores.variants] != [estimate.stem for estimate in estimates]:
        return score(folder)
    return scores
