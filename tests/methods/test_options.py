import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from datasets.errors import DataError, UnknownName
from methods.gaussian_splatting.spec import SPEC
from methods.interface import Option
from methods.options import check, parse_assignments, resolve


def test_preset_overlays_defaults_and_the_user_overlays_the_preset():
    assert SPEC.options["sh_rest_lr"].default == 1.25e-4
    quick = resolve(SPEC, "quick")
    assert (quick.options["sh_rest_lr"], quick.iterations, quick.variant) == (1e-3, 1_200, "")
    own = resolve(SPEC, "quick", {"sh_rest_lr": "0.002", "iterations": "7_000", "sh_degree": "3"})
    assert (own.options["sh_rest_lr"], own.iterations) == (0.002, 7_000)
    assert own.variant == "iterations=7000,sh_rest_lr=0.002", "what equals the preset is no variant"
    assert set(own.options) == set(SPEC.options)


def test_resolving_leaves_the_spec_as_it_was():
    before = {name: option.default for name, option in SPEC.options.items()}
    resolve(SPEC, "quick", {"background": "black"})
    assert {name: option.default for name, option in SPEC.options.items()} == before
    assert resolve(SPEC, "quick").options["background"] == "scene"


def test_unknown_names_come_with_near_matches():
    with pytest.raises(UnknownName, match="background"):
        resolve(SPEC, "quick", {"backgrund": "white"})
    with pytest.raises(UnknownName, match="quick"):
        resolve(SPEC, "quik")
    with pytest.raises(UnknownName, match="iterations"):
        resolve(SPEC, "quick", {"iteration": 3})


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("background", "grey", "not one of scene, white, black, random"),
        ("background", 3, "not a text"),
        ("sh_degree", 4, "above the maximum 3"),
        ("sh_degree", "2.5", "not a whole number"),
        ("sh_degree", True, "not a whole number"),
        ("ssim_weight", "nan", "not a finite number"),
        ("ssim_weight", "a lot", "not a finite number"),
        ("ssim_weight", -0.1, "below the minimum 0"),
        ("opacity_reset", "perhaps", "not true or false"),
        ("opacity_reset", 1, "not true or false"),
        ("iterations", 0, "below the minimum 1"),
    ],
)
def test_bad_values_are_refused_with_option_reason_and_meaning(name, value, reason):
    with pytest.raises(DataError) as caught:
        resolve(SPEC, "quick", {name: value})
    assert f"3dgs.{name}" in str(caught.value)
    assert reason in caught.value.reason
    assert "default" in caught.value.remedy


@pytest.mark.parametrize(
    ("text", "value"), [("true", True), ("Yes", True), ("1", True), ("off", False), ("0", False)]
)
def test_texts_of_truth(text, value):
    assert resolve(SPEC, "quick", {"opacity_reset": text}).options["opacity_reset"] is value


@settings(deadline=None)
@given(st.integers(-(10**6), 10**6))
def test_whole_numbers_survive_as_text(number):
    value = check("m", "o", Option(5, "a number"), str(number))
    assert value == number
    assert isinstance(value, int)


@settings(deadline=None)
@given(st.floats(allow_nan=False, allow_infinity=False))
def test_numbers_survive_as_text(number):
    value = check("m", "o", Option(0.5, "a number"), repr(number))
    assert value == number
    assert isinstance(value, float)


def test_assignments_are_split_at_the_last_dot_and_first_equals_sign():
    parsed = parse_assignments(["3dgs.background=white", "3dgs.iterations = 50", "other.o=a=b"])
    assert parsed == {"3dgs": {"background": "white", "iterations": "50"}, "other": {"o": "a=b"}}


@pytest.mark.parametrize("text", ["", "3dgs", "3dgs.background", "background=white", ".x=1", "3dgs.=1"])
def test_malformed_assignments_are_refused_with_an_example(text):
    with pytest.raises(DataError, match=r"method\.option=value"):
        parse_assignments([text])


def test_one_option_set_twice_is_refused():
    assert parse_assignments(["m.o=1", "m.o=1"]) == {"m": {"o": "1"}}
    with pytest.raises(DataError, match="already set"):
        parse_assignments(["m.o=1", "m.o=2"])
