"""Options of a variant: its name with values for some of its stages, `NAME:stage=value,stage=value`.

The whole text is the variant's name, and the name of its file in estimates/. It consists of allowed names and values
and of `:`, `=` and `,`, so it is a valid file name on systems that allow a colon (not on Windows).
"""

from collections.abc import Mapping, Sequence

from estimator.errors import InputError


def read_options(name: str, stages: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Values that `name` gives after its first colon, by stage; `stages` are the allowed values, by stage.

    Raises InputError, which names what is allowed, for an unknown stage or value, and for a stage given twice.
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
            raise InputError(f"variant {name}: {stage} is given twice")
        chosen[stage] = value
    return chosen
