"""A pipeline's name with some of its stages chosen: `NAME:stage=value,stage=value`.

The whole text is the variant's name, also of its file in estimates/. It holds nothing but names and values that are
allowed, and `:`, `=` and `,`, so it is a file name wherever a colon may stand in one (not on Windows).
"""

from collections.abc import Mapping, Sequence

from estimator.errors import InputError


def read_options(name: str, stages: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """The stages that `name` chooses after its first colon, by stage; `stages` are the values allowed, by stage.

    Raises InputError, naming what is wrong and what is allowed, for a stage or value unknown, and a stage chosen twice.
    """
    chosen: dict[str, str] = {}
    for part in name.partition(":")[2].split(","):
        stage, equals, value = part.partition("=")
        if not equals:
            raise InputError(f"variant {name}: {part!r} is not stage=value; stages: {', '.join(stages)}")
        if stage not in stages:
            raise InputError(f"variant {name}: unknown stage {stage!r}; allowed: {', '.join(stages)}")
        if value not in stages[stage]:
            raise InputError(f"variant {name}: {stage}={value!r} is unknown; allowed: {', '.join(stages[stage])}")
        if stage in chosen:
            raise InputError(f"variant {name}: {stage} is chosen twice")
        chosen[stage] = value
    return chosen
