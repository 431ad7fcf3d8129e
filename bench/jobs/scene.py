"""Jobs about a scene or composition without a method."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Self

from econgs_bench.bench.store.records import Job


class SceneJob(Job):
    """Its views, cost of rendering or complexity."""

    @classmethod
    def of(
        cls,
        about: Mapping[str, Any],
        content: str,
        scenes: tuple[str, ...],
        composition: str = "",
        edit: str = "",
        stress: str = "",
    ) -> Self:
        """The job of a scene.

        Args:
            about: dataset, views, split and preset, as fields.
            content: hash of the scene or composition.
            scenes: basic scenes.
            composition: its name, if it is one.
            edit: change before rendering.
            stress: that decides the job.
        """
        identity = {"scene": content, **cls.protocol(about)}
        if edit:
            identity["edit"] = edit
        if stress:
            identity["stress"] = stress
        return cls.made(identity, **about, scenes=scenes, composition=composition, edit=edit, stress=stress)

    @classmethod
    def protocol(cls, about: Mapping[str, Any]) -> dict[str, Any]:
        """What beside the scene decides the result."""
        return {}
