"""The suite ``departures`` takes back each departure of ECoNGS from the paper."""

from econgs_bench.bench.suites.suite import load_suite
from econgs_bench.methods.econgs.spec import SPEC
from econgs_bench.methods.options import resolve


def test_every_departure_is_taken_back() -> None:
    suite = load_suite("departures")
    variants = [dict(one["econgs"]) for one in suite.variants if one]
    assert {"configuration": "paper"} in variants
    taken = {name: value for one in variants for name, value in one.items() if name != "configuration"}
    settings = [resolve(SPEC, suite.preset, {"configuration": one}) for one in ("fair", "paper")]
    ours, theirs = ({"iterations": one.iterations, **one.values} for one in settings)
    assert taken == {name: value for name, value in theirs.items() if value != ours[name]}
