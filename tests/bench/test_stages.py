"""What a stage refuses before it begins."""

from dataclasses import replace

import pytest

from bench.stages import _refuse_without_volume
from methods.contract.scene import tiny_scene
from methods.gaussian_splatting.spec import SPEC
from methods.interface import Refused


def test_a_method_that_reads_volumes_refuses_scenes_that_have_only_views():
    reads = replace(SPEC, needs_volume=True)
    with pytest.raises(Refused, match="scene 'there' has only views"):
        _refuse_without_volume(reads, [tiny_scene("here", volume=True), tiny_scene("there")])
    _refuse_without_volume(reads, [tiny_scene("here", volume=True)])
    _refuse_without_volume(SPEC, [tiny_scene("there")])
