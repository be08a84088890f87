"""Options of a variant's name: allowed and refused ones, and names as file names."""

import itertools

import pytest

from estimator.errors import InputError
from estimator.methods.catalogue import OWN, variant_named
from estimator.methods.huynh2016 import AS_PRINTED, DEFAULTS, STAGES, Huynh2016
from estimator.methods.options import read_options

COLOURS = {"hue": ("red", "blue"), "shade": ("light", "dark")}


def test_stages_are_read_in_any_order() -> None:
    assert read_options("paint:shade=dark,hue=red", COLOURS) == {"hue": "red", "shade": "dark"}


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("paint:", "variant paint:: '' is not stage=value; stages: hue, shade"),
        ("paint:hue", "variant paint:hue: 'hue' is not stage=value; stages: hue, shade"),
        ("paint:hue=red,", "variant paint:hue=red,: '' is not stage=value; stages: hue, shade"),
        ("paint:tone=red", "variant paint:tone=red: unknown stage 'tone'; allowed: hue, shade"),
        ("paint:hue=", "variant paint:hue=: hue='' is unknown; allowed: red, blue"),
        ("paint:hue=dark", "variant paint:hue=dark: hue='dark' is unknown; allowed: red, blue"),
        ("paint:hue=red=blue", "variant paint:hue=red=blue: hue='red=blue' is unknown; allowed: red, blue"),
        ("paint:hue=../../red", "variant paint:hue=../../red: hue='../../red' is unknown; allowed: red, blue"),
        ("paint:hue=red,hue=red", "variant paint:hue=red,hue=red: hue is given twice"),
    ],
)
def test_what_is_wrong_is_named(name: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        read_options(name, COLOURS)
    assert str(error.value) == message


def test_a_variant_keeps_the_name_it_was_given() -> None:
    name = "huynh2016:denoise=none,spot=brightest,ranges=printed,position=z-shift"
    variant = variant_named(name)
    assert variant.name == name
    assert variant.estimate == Huynh2016("none", "brightest", "corrected", "printed", "z-shift")


def test_what_is_not_chosen_is_as_in_huynh2016() -> None:
    plain = Huynh2016("corrected", "centroid", "corrected", "corrected", "direct")
    assert variant_named("huynh2016").estimate == variant_named("huynh2016:spot=centroid").estimate == plain


def test_as_printed_is_a_choice_of_stages_and_shares_none_with_the_default() -> None:
    chosen = ",".join(f"{stage}={value}" for stage, value in AS_PRINTED.items())
    assert variant_named(f"huynh2016:{chosen}").estimate == variant_named("huynh2016-as-printed").estimate
    assert not AS_PRINTED.items() & DEFAULTS.items()


def test_all_choices_are_file_names() -> None:
    for values in itertools.product(*STAGES.values()):
        name = "huynh2016:" + ",".join(f"{stage}={value}" for stage, value in zip(STAGES, values, strict=True))
        assert set(variant_named(name).name) <= set("abcdefghijklmnopqrstuvwxyz0123456789-:=,")
        assert len(name) < 200


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("best", f"variant best: unknown; allowed: {', '.join(OWN)}"),
        ("best:spot=centroid", f"variant best:spot=centroid: unknown; allowed: {', '.join(OWN)}"),
        (
            "pnp:spot=centroid",
            "variant pnp:spot=centroid: pnp has no options; those that have: huynh2016, gravity-fit, up2p",
        ),
        (
            "up2p:spot=centroid",
            "variant up2p:spot=centroid: 'spot=centroid' is no option; allowed: centroid-sigma=PIXELS",
        ),
        *(
            (
                f"gravity-fit:centroid-sigma={value}",
                f"variant gravity-fit:centroid-sigma={value}: "
                f"centroid-sigma={value!r} is not a number of pixels from 0 to 1000",
            )
            for value in ("", "-1", "nan", "1e3", "1001", "0.5,centroid-sigma=1")
        ),
    ],
)
def test_names_there_are_none_of(name: str, message: str) -> None:
    with pytest.raises(InputError) as error:
        variant_named(name)
    assert str(error.value) == message


@pytest.mark.parametrize("name", OWN)
def test_plain_names_are_variants(name: str) -> None:
    assert variant_named(name) is OWN[name]


def test_a_centroid_sigma_is_part_of_the_name() -> None:
    """Two variants of one name are equal, as worker processes need it, and of another value are not."""
    half, again, one = (variant_named(f"gravity-fit:centroid-sigma={value}") for value in ("0.5", "0.5", "1"))
    assert half.name == "gravity-fit:centroid-sigma=0.5"
    assert half == again != one
