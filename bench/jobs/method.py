"""What jobs about a method have in common, and the identity of those that train one."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from typing import Any, Self

from pydantic import Field

from econgs_bench.bench.store.records import SCHEMA, Count, Job, Record, Request, Value, Whole
from econgs_bench.methods.interface import MethodSpec
from econgs_bench.methods.options import ITERATIONS, Settings, label

_KNOBS = ("rate_weight", "lambda", "lambda_e")
"""Rate knobs that need a fit for each value, of all methods of schema 2."""


class MethodJob(Job):
    """A job about a method.

    Attributes:
        group: label of the scenes that were fitted together; labels of several groups (measure of a
            composition) are joined by commas.
        overrides: options that differ from the preset's, with "iterations" and "configuration";
            ``variant`` is their label.
        knob: the rate knob among the overrides, "" if there is none.
        cloud_points: points of the initial cloud.
    """

    group: str = ""
    method: str
    variant: str = ""
    seed: Whole = 0
    options: dict[str, Value] = Field(default_factory=dict)
    overrides: dict[str, Value] = Field(default_factory=dict)
    knob: str = ""
    iterations: Count | None = None
    device: str = "cpu"
    cloud_points: Count = 10_000

    @classmethod
    def after(cls, job: MethodJob, identity: Mapping[str, Any], **fields: Any) -> Self:
        """A job that follows another one of the same method and group."""
        own = {"kind", "key", "identity", "needs"}
        same = {name: getattr(job, name) for name in MethodJob.model_fields if name not in own}
        return cls.made(identity, **{**same, **fields})

    @property
    def _about(self) -> str:
        return self.composition or self.group or "+".join(self.scenes)

    @property
    def _settings(self) -> list[str]:
        variant = f"[{self.variant}]" if self.variant else ""
        seed = [f"seed {self.seed}"] if self.seed else []
        return [self.method + variant, *self._rate, *seed]

    @property
    def _rate(self) -> list[str]:
        return []

    @property
    def cell(self) -> tuple[Any, ...]:
        return self.method, self.variant, self.seed, self.device.split(":")[0]

    def axes(self) -> dict[str, Any]:
        return super().axes() | {
            "group": self.group,
            "method": self.method,
            "variant": self.variant,
            "base": label({name: value for name, value in self.overrides.items() if name != self.knob}),
            "options": json.dumps(self.overrides),
            "knob": self.knob or None,
            "knob_value": self.overrides.get(self.knob),
            "seed": self.seed,
            "iterations": self.iterations,
            "device": self.device,
        }

    def migrated(self, record: Record) -> Record:
        """Schema 2 had overrides and rate knob in the label alone."""
        if record.schema_version == SCHEMA:
            return record
        labels = dict(text.split("=", 1) for text in self.variant.split(",") if text)
        typed = self.options | ({} if self.iterations is None else {ITERATIONS: self.iterations})
        overrides = {name: typed.get(name, text) for name, text in labels.items()}
        knob = next((name for name in _KNOBS if name in overrides), "")
        job = record.job.model_copy(update={"overrides": overrides, "knob": knob})
        return super().migrated(record.model_copy(update={"job": job}))


class ModelJob(MethodJob):
    """A job about a saved model; its rate, or None for the method's own."""

    rate: float | None = None

    @property
    def _rate(self) -> list[str]:
        return [] if self.rate is None else [f"rate {self.rate:g}"]

    @property
    def cell(self) -> tuple[Any, ...]:
        return *super().cell, self.rate

    def axes(self) -> dict[str, Any]:
        return super().axes() | {"rate": self.rate}


class TrainingJob(MethodJob):
    """A partition of scenes, or the fit of a group."""

    @property
    def method_version(self) -> str:
        """That of the method that it ran."""
        return str(self.identity["method"][1])

    @classmethod
    def of(
        cls,
        about: Mapping[str, Any],
        scenes: Mapping[str, str],
        spec: MethodSpec,
        settings: Settings,
        *,
        iterations: int,
        seed: int,
        device: str,
        stress: str,
        points: int,
        needs: Iterable[str],
        **more: Any,
    ) -> Self:
        """The job of a method's settings.

        Args:
            about: dataset, views, split and preset, as fields.
            scenes: name -> content hash.
            spec: of the method.
            settings: resolved options.
            iterations: the budget.
            seed: of the fit.
            device: that it runs on.
            stress: that decides training.
            points: of the initial clouds.
            needs: ids of jobs.
            more: of its identity.
        """
        request: Request = about["request"]
        identity = {
            "dataset": about["dataset_name"],
            "scenes": [[name, content] for name, content in scenes.items()],
            "method": [spec.name, spec.version],
            "options": settings.values,
            "iterations": iterations,
            "seed": seed,
            "device": device.split(":")[0],
            "views": [request.train_views, request.width, request.height],
            "trains_on": "train" if about["split"] == "val" else "trainval",
            "cloud_points": points,
            **more,
        }
        if request.samples != 1:
            identity["samples"] = request.samples
        if stress:
            identity["stress"] = stress
        return cls.made(
            identity,
            **about,
            needs=tuple(needs),
            scenes=tuple(scenes),
            group=cls.labelled(scenes),
            method=spec.name,
            variant=settings.variant,
            seed=seed,
            options=settings.values,
            overrides=settings.overrides,
            knob=settings.knob,
            iterations=iterations,
            stress=stress,
            device=device,
            cloud_points=points,
        )

    @classmethod
    def labelled(cls, scenes: Iterable[str]) -> str:
        """The label of scenes that are fitted together."""
        return ""
