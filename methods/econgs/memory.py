"""Estimate of the memory that training a group needs."""

from __future__ import annotations

import os
from collections.abc import Sequence

from econgs_bench.datasets.scratch import is_mapped
from econgs_bench.econgs.codec.symbols import SCALINGS
from econgs_bench.methods.econgs.spec import EcongsOptions
from econgs_bench.methods.econgs.start import starting_points
from econgs_bench.methods.interface import Refused, SceneInput

MIB = 2**20
PROCESS = 600 * MIB
"""Python, torch and the kernels, before any scene."""
GROWTH = 2.0
"""Anchors after growing over those at the start, at most, as a rule (``max_anchors`` bounds them)."""
COPIES = 6
"""Value, gradient, two moments, the visible rows and their noisy copy."""


def group_bytes(group: Sequence[SceneInput], options: EcongsOptions) -> int:
    """Peak host memory of training a group: its views, its anchors and what belongs to them, one frame.

    Views that lie in a file (:mod:`.datasets.scratch`) take none.
    """
    values = options.features + SCALINGS + 3 * options.offsets
    images = [views.images for scene in group for views in (scene.train, scene.validation)]
    views = sum(one.nbytes for one in images if not is_mapped(one))
    anchors = [_anchors(scene, options) for scene in group]
    parameters = sum(anchors) * values * 4 * COPIES
    # One frame decodes and splats the Gaussians of one scene: about 200 bytes each with their gradients.
    frame = max(anchors) * options.offsets * 200
    return int(PROCESS + views + parameters + frame)


def fit_to_memory(groups: Sequence[Sequence[SceneInput]], options: EcongsOptions) -> list[list[SceneInput]]:
    """Groups that will not fit are halved, in the order of their scenes, until they do.

    Raises:
        Refused: a scene that does not fit alone; names the estimate.
    """
    limit = options.group_memory_mb * MIB or available()
    result: list[list[SceneInput]] = []
    queue = [list(group) for group in reversed(groups)]
    while queue:
        group = queue.pop()
        estimate = group_bytes(group, options)
        if estimate <= limit:
            result.append(group)
        elif len(group) == 1:
            raise Refused(
                f"scene {group[0].name!r} needs about {estimate // MIB} MiB and {limit // MIB} MiB are free: "
                "use fewer or smaller views, or set group_memory_mb"
            )
        else:
            middle = len(group) // 2
            queue += [group[middle:], group[:middle]]
    return result


def available() -> int:
    """Bytes of host memory that a new process may take."""
    try:
        with open("/proc/meminfo", encoding="ascii") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return int(line.split()[1]) * 1024
    except OSError:
        pass
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _anchors(scene: SceneInput, options: EcongsOptions) -> int:
    if options.start == "random" or len(scene.cloud) == 0:  # who starts from no cloud is refused later
        start = options.random_points
    else:
        start = len(starting_points(scene, options, 0)[0])
    limit = options.max_anchors
    return min(int(GROWTH * start), limit) if limit else int(GROWTH * start)
