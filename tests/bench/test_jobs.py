"""What a job refuses before it begins."""

from dataclasses import replace

import pytest

from bench.jobs.fit import refuse_without_volume
from methods.contract.scene import tiny_scene
from methods.gaussian_splatting.spec import SPEC
from methods.interface import Refused


def test_a_method_that_reads_volumes_refuses_scenes_that_have_only_views():
    reads = replace(SPEC, needs_volume=True)
    with pytest.raises(Refused, match="scene 'there' has only views"):
        refuse_without_volume(reads, [tiny_scene("here", volume=True), tiny_scene("there")])
    refuse_without_volume(reads, [tiny_scene("here", volume=True)])
    refuse_without_volume(SPEC, [tiny_scene("there")])
