"""Croissant metadata (JSON-LD) of a set as it is: files with digests, and the columns of its tables.

Source: Croissant Format Specification 1.0. Paths are relative to the file that is written. Of lists, those of fixed
length are fields with `repeated`; `spots` and `leds` have no field.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from vlcrender.config.toml_model import Settings
from vlcrender.core.digest import sha256_of
from vlcrender.dataset.format.files import FRAMES, write_json
from vlcrender.dataset.format.rows import FrameRow, TruthRow
from vlcrender.export.source import Source

TYPES = {int: "sc:Integer", float: "sc:Float", str: "sc:Text", bool: "sc:Boolean"}
TERMS = (
    *(
        "citeAs",
        "column",
        "equivalentProperty",
        "extract",
        "field",
        "fileProperty",
        "fileObject",
        "fileSet",
        "format",
        "includes",
    ),
    *("isLiveDataset", "jsonPath", "key", "md5", "parentField", "path", "recordSet", "references", "regex", "repeated"),
    *("replace", "samplingRate", "separator", "source", "subField", "transform"),
)
CONTEXT = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "sc": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "dct": "http://purl.org/dc/terms/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in TERMS},
}
PARQUET = "application/x-parquet"


def write(source: Source, out: Path) -> Mapping[str, Any]:
    """Write the metadata to the file `out`."""
    write_json(out, metadata(source, out.absolute().parent))
    return {}


def metadata(source: Source, folder: Path) -> dict[str, Any]:
    """The metadata, for a file in `folder`."""
    dataset = source.dataset
    recipe = dataset.provenance.get("recipe", {})
    below = Path(os.path.relpath(source.directory.absolute(), folder)).as_posix()
    prefix = "" if below == "." else f"{below}/"
    tables: dict[str, type[Settings]] = {"frames": FrameRow}
    if source.has_truth:
        tables["truth"] = TruthRow
    files = {"dataset.json": "application/json", **{f"{name}.parquet": PARQUET for name in tables}}
    images = sorted({Path(row.file).suffix for row in source.frames})
    tree: dict[str, Any] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": dataset.name,
        "description": recipe.get("description") or "Rendered images of ceiling LEDs.",
        "version": f"{dataset.version}.0.0",
        "keywords": ["visible light positioning", "synthetic", "camera"],
        "distribution": [
            *(_file(source.directory / name, prefix + name, form) for name, form in files.items()),
            *(_image_set(prefix, suffix) for suffix in images),
        ],
        "recordSet": [_record_set(name, model) for name, model in tables.items()],
    }
    if dataset.licence is not None:
        tree["license"] = f"https://spdx.org/licenses/{dataset.licence}.html"
    return tree


def _file(path: Path, url: str, form: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileObject",
        "@id": path.name,
        "name": path.name,
        "contentUrl": url,
        "contentSize": f"{path.stat().st_size} B",
        "encodingFormat": form,
        "sha256": sha256_of(path),
    }


def _image_set(prefix: str, suffix: str) -> dict[str, Any]:
    return {
        "@type": "cr:FileSet",
        "@id": f"images{suffix}",
        "name": f"images{suffix}",
        "description": "Raw images; frames.parquet has the SHA-256 of each.",
        "encodingFormat": "image/png" if suffix == ".png" else "image/x-exr",
        "includes": f"{prefix}{FRAMES}/*{suffix}",
    }


def _record_set(name: str, model: type[Settings]) -> dict[str, Any]:
    fields = [_field(name, column, field.annotation) for column, field in model.model_fields.items()]
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "key": {"@id": f"{name}/frame"},
        "field": [field for field in fields if field is not None],
    }


def _field(table: str, column: str, annotation: Any) -> dict[str, Any] | None:
    """A column of numbers, text, or lists of numbers; None for lists of structures."""
    if get_origin(annotation) in (Union, UnionType):
        (annotation,) = (one for one in get_args(annotation) if one is not type(None))
    annotation = _plain(annotation)
    repeated = get_origin(annotation) is tuple
    item = _plain(get_args(annotation)[0]) if repeated else annotation
    if item not in TYPES:
        return None
    return {
        "@type": "cr:Field",
        "@id": f"{table}/{column}",
        "name": column,
        "dataType": TYPES[item],
        **({"repeated": True} if repeated else {}),
        "source": {"fileObject": {"@id": f"{table}.parquet"}, "extract": {"column": column}},
    }


def _plain(annotation: Any) -> Any:
    """A type without its limits."""
    return get_args(annotation)[0] if get_origin(annotation) is Annotated else annotation
