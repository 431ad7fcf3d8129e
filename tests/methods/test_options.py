import json
from datetime import date

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from econgs_bench.datasets.errors import DataError, UnknownName
from econgs_bench.methods import reference
from econgs_bench.methods.econgs.spec import SPEC as ECONGS
from econgs_bench.methods.gaussian_splatting.spec import SPEC, GaussianOptions
from econgs_bench.methods.interface import Option
from econgs_bench.methods.options import check, current, declared, parse_assignments, resolve
from econgs_bench.methods.registry import Registry
from econgs_bench.methods.vq_3dgs.spec import VqOptions


def test_preset_overlays_defaults_and_the_user_overlays_the_preset():
    assert GaussianOptions().sh_rest_lr == 1.25e-4
    quick = resolve(SPEC, "quick")
    assert (quick.options.sh_rest_lr, quick.iterations, quick.variant) == (8.5e-4, 1_200, "")
    own = resolve(SPEC, "quick", {"sh_rest_lr": "0.002", "iterations": "7_000", "sh_degree": "3"})
    assert (own.options.sh_rest_lr, own.iterations) == (0.002, 7_000)
    assert own.variant == "iterations=7000,sh_rest_lr=0.002", "what equals the preset is no variant"
    assert set(own.values) == set(declared(GaussianOptions))


def test_a_former_name_of_an_option_sets_it():
    now, then = (resolve(SPEC, "quick", {name: "0.05"}) for name in ("prune_loss_db", "rent"))
    assert now == then
    assert now.variant == "prune_loss_db=0.05"
    assert current(GaussianOptions, {"rent": 0.02, "sh_degree": 3}) == {"prune_loss_db": 0.02, "sh_degree": 3}


BY_SCHEDULE = {"ccnerf": {"first_side", "side", "rays"}, "plenoxels": {"resolution"}}
"""Options whose published values belong to a schedule that shorter presets shorten."""


@pytest.mark.parametrize("spec", Registry().specs.values(), ids=lambda spec: spec.name)
def test_published_settings_are_the_same_in_every_preset(spec):
    if "paper" in spec.configurations:
        own = [resolve(spec, preset, {"configuration": "paper"}).values for preset in spec.iterations]
        names = {name for values in own for name in values if values[name] != own[0][name]}
        assert names == BY_SCHEDULE.get(spec.name, set()), (
            "what a search found for a preset is published nowhere"
        )


def test_a_group_has_the_iterations_of_its_scenes():
    quick = resolve(ECONGS, "quick")
    assert quick.budget(4) == 4 * quick.iterations
    assert resolve(ECONGS, "quick", {"configuration": "paper"}).budget(4) == 1_600
    assert resolve(SPEC, "quick").budget(4) == 1_200


def test_declarations_carry_range_and_choices():
    options = declared(VqOptions)
    assert options["sh_degree"] == Option(3, "final degree of the spherical harmonics", 0, 3)
    assert options["background"].choices == ("scene", "white", "black", "random")
    assert options["codebook_size"].choices == (16, 64, 256, 1024)
    assert options["tuning"].maximum == 0.9


def test_records_hold_numbers_of_the_declared_types():
    values = resolve(SPEC, "quick", {"prune_opacity": "0", "max_gaussians": "5.0", "start": "random"}).values
    assert [repr(values[name]) for name in ("prune_opacity", "max_gaussians", "start")] == [
        "0.0",
        "5",
        "'random'",
    ]
    assert SPEC.options(**json.loads(json.dumps(values))) == SPEC.options(**values)


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
        ("iterations", "1e19", "not a whole number"),
        ("iterations", date(2020, 1, 1), "not a whole number"),
        ("sh_degree", [1], "not a whole number"),
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
    assert resolve(SPEC, "quick", {"opacity_reset": text}).options.opacity_reset is value


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


def test_the_page_of_options_has_every_option_of_every_method():
    sections = dict(part.split("\n", 1) for part in reference.page().split("\n## ")[1:])
    registry = Registry()
    assert list(sections) == list(registry.built_in())
    for name, text in sections.items():
        assert all(f"| `{option}` |" in text for option in declared(registry.spec(name).options))
