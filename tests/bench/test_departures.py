"""The suite ``departures`` takes back each departure of ECoNGS from the paper."""

from bench.suites import load_suite
from methods.econgs.spec import SPEC
from methods.options import resolve


def test_every_departure_is_taken_back() -> None:
    variants = [dict(one["econgs"]) for one in load_suite("departures").variants if one]
    assert {"configuration": "paper"} in variants
    taken = {name: value for one in variants for name, value in one.items() if name != "configuration"}
    ours, theirs = (vars(resolve(SPEC, "quick", {"configuration": one}).options) for one in ("fair", "paper"))
    assert taken == {name: value for name, value in theirs.items() if value != ours[name]}
