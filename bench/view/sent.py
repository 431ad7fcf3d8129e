"""The page of `bench view` as one file that shows one model without a server.

Gaussians are stored once, in scene units, and drawn by the model's own filters. Where a model decodes or
shades them for each view, they are the mean over the training views, their colors a fit of spherical
harmonics (:mod:`.methods.baking.bake`).
"""

from __future__ import annotations

import base64
import hashlib
import html
import json
import math
import re
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.view.sources import Opened
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.edits import Edit
from econgs_bench.datasets.errors import DataError, printable
from econgs_bench.datasets.scene import RGB

if TYPE_CHECKING:
    import torch

    from econgs_bench.methods.gaussian_splatting.model import GaussianModel, SceneGaussians
    from econgs_bench.methods.shared.rendering import Rendering

EDITS = frozenset({"opacity", "palette"})
"""Edits that the page can make, of a model that can."""
_STEPS = (1 << 16) - 1
_MOST_LOGIT = 12.0
_SMALLEST = 1e-9  # scene units
_PALETTES = (0.4, 0.6)  # greys at which the response to the palette is measured
_TITLE = "<title>bench view</title>"


@dataclass(frozen=True, eq=False)
class Part:
    """A scene of the page.

    Attributes:
        gaussians: in scene units.
        palette: the color from which edits start; None: its palette cannot be edited.
        response: (N,) change of each color with the palette color; given with ``palette``.
    """

    gaussians: SceneGaussians
    palette: RGB | None = None
    response: torch.Tensor | None = None

    def columns(self) -> dict[str, NDArray[np.float32]]:
        """(N, width) numbers of the file by name."""
        import torch

        one = self.gaussians
        terms = (one.sh_degree + 1) ** 2
        values = {
            "means": one.means,
            "quats": torch.nn.functional.normalize(one.quats, dim=1),
            "scales": one.log_scales.clamp_min(math.log(_SMALLEST)),
            "opacities": one.logits[:, None].clamp(-_MOST_LOGIT, _MOST_LOGIT),
            "harmonics": torch.cat([one.sh_dc, one.sh_rest], 1)[:, :terms].flatten(1),
        }
        if self.response is not None:
            values["response"] = self.response[:, None]
        return {name: value.detach().cpu().numpy().astype(np.float32) for name, value in values.items()}


def rendering(opened: Opened) -> Rendering:
    """How the Gaussians of a page are drawn: as its model's, in scene units, smoothing in their scales."""
    from econgs_bench.methods.shared.rendering import Rendering

    own = opened.model.rendering  # type: ignore[union-attr]
    return Rendering(1.0, replace(own.low_pass, smoothing=0.0))


def part(opened: Opened, scene: str, cameras: Sequence[Camera], background: RGB) -> Part:
    """A scene as the page holds it.

    Args:
        opened: holds the model.
        scene: name of its scene.
        cameras: of training views, for what depends on the view.
        background: the scene's.

    Raises:
        DataError: the model does not consist of Gaussians, or no camera sees them.
    """
    import torch

    from econgs_bench.methods.baking.bake import baked_rows
    from econgs_bench.methods.gaussian_splatting.model import SplatModel
    from econgs_bench.methods.interface import HasGaussians, Splatted

    model = opened.model
    if isinstance(model, SplatModel):
        own, units = model.scene(scene), model.rendering.units
        smoothing = math.sqrt(model.rendering.low_pass.smoothing)
        scales = torch.hypot(own.log_scales.exp(), own.log_scales.new_tensor(smoothing)) * units
        return Part(replace(own, means=own.means * units, log_scales=scales.clamp_min(_SMALLEST).log()))
    if not (isinstance(model, HasGaussians) and isinstance(model, Splatted)):
        raise DataError(scene, "its model does not consist of Gaussians", "Export one of another method")
    gaussians, rows = baked_rows(model, scene, cameras, background, None)
    if "palette" not in opened.edits:
        return Part(gaussians)
    return Part(gaussians, *_response(model, scene, cameras, rows))


def _response(
    model: Any, scene: str, cameras: Sequence[Camera], rows: torch.Tensor
) -> tuple[RGB, torch.Tensor] | tuple[None, None]:
    """The palette color of a scene as it was trained, and (N,) how colors of Gaussians follow it.

    Means over views, weighted by opacity. None, where an edit also changes which Gaussians there are.
    """
    import torch

    from econgs_bench.methods.baking.bake import MOST_VIEWS

    low, high = _PALETTES
    sums, weights = torch.zeros(int(rows.max()) + 1), torch.zeros(int(rows.max()) + 1)
    moved, squares = torch.zeros(3), 0.0
    with torch.inference_mode():
        for camera in cameras[:: max(1, -(-len(cameras) // MOST_VIEWS))]:
            own, numbers = model.splats(scene, camera)
            dark, light = (
                model.splatted(camera, [scene], {scene: Edit(palette=(one, one, one))}).features.cpu()
                for one in _PALETTES
            )
            if not len(own.features) == len(dark) == len(light):
                return None, None
            slope = (light - dark).mean(1) / (high - low)
            weight = own.opacities.cpu() * (own.opacities.cpu() > 0.0)
            numbers = numbers.cpu()
            inside = numbers < len(sums)
            sums.index_add_(0, numbers[inside], (weight * slope)[inside])
            weights.index_add_(0, numbers[inside], weight[inside])
            moved += ((own.features.cpu() - 0.5 * (dark + light)) * (weight * slope)[:, None]).sum(0)
            squares += float((weight * slope.square()).sum())
    middle = 0.5 * (low + high)
    red, green, blue = (middle + moved / max(squares, 1e-12)).clamp(0.0, 1.0).tolist()
    return (red, green, blue), (sums / weights.clamp_min(1e-12))[rows].clone()


@dataclass(frozen=True)
class _Packed:
    """Numbers of a scene in 16 bits: integers (columns, N), and least value and step of each column."""

    names: dict[str, int]
    integers: NDArray[np.uint16]
    ranges: NDArray[np.float64]

    @classmethod
    def of(cls, one: Part) -> _Packed:
        columns = one.columns()
        table = np.concatenate(list(columns.values()), axis=1).T.astype(np.float64)
        if not np.isfinite(table).all():
            raise DataError(
                one.gaussians.name, "its model holds numbers that are not finite", "Train it again"
            )
        least = table.min(axis=1)
        step = np.maximum((table.max(axis=1) - least) / _STEPS, 1e-30)
        integers = np.rint((table - least[:, None]) / step[:, None]).astype(np.uint16)
        widths = {name: value.shape[1] for name, value in columns.items()}
        return cls(widths, integers, np.stack([least, step], axis=1))

    def text(self) -> str:
        """As embedded.js reads it."""
        planes = (self.integers >> 8).astype(np.uint8).tobytes() + self.integers.astype(np.uint8).tobytes()
        return base64.b64encode(zlib.compress(planes, 9)).decode()

    def facts(self, one: Part) -> dict[str, Any]:
        """What embedded.js has to know of it."""
        return {
            "name": one.gaussians.name,
            "count": self.integers.shape[1],
            "columns": list(self.names.items()),
            "ranges": self.ranges.ravel().tolist(),
            "palette": one.palette,
        }

    def gaussians(self, like: SceneGaussians) -> SceneGaussians:
        """What the page reads."""
        import torch

        from econgs_bench.methods.gaussian_splatting.model import SH_REST

        table = torch.from_numpy(
            (self.ranges[:, :1] + self.ranges[:, 1:] * self.integers).T.astype(np.float32)
        )
        values = dict(zip(self.names, table.split(list(self.names.values()), 1), strict=True))
        harmonics = torch.zeros((len(table), 1 + SH_REST, 3))
        known = values["harmonics"].reshape(len(table), -1, 3)
        harmonics[:, : known.shape[1]] = known
        return replace(
            like, means=values["means"].contiguous(), quats=values["quats"].contiguous(),
            log_scales=values["scales"].contiguous(), logits=values["opacities"][:, 0].contiguous(),
            sh_dc=harmonics[:, :1].contiguous(), sh_rest=harmonics[:, 1:].contiguous(),
        )  # fmt: skip


@dataclass(frozen=True)
class Sent:
    """A page, written.

    Attributes:
        text: the file.
        model: what the page shows, for comparison.
        half: bytes of its Gaussians at 16 bits a number.
    """

    text: str
    model: GaussianModel
    half: int


def sent(opened: Opened, label: str, parts: Sequence[Part]) -> Sent:
    """The page of scenes.

    Args:
        opened: the model.
        label: heading, for people.
        parts: scenes, at least one.

    Raises:
        DataError: a number is not finite.
    """
    from econgs_bench.methods.gaussian_splatting.model import GaussianModel

    packed = [_Packed.of(one) for one in parts]
    drawn = rendering(opened)
    low = drawn.low_pass
    facts = {
        "about": {"sources": [printable(label)], "scale": [0] * 768, "most": 0, "sent": True},
        "open": _about(opened, parts),
        "filter": {
            "variance": low.variance,
            "compensated": low.compensated,
            "rayPower": low.ray_power,
            "points": low.points,
        },
        "parts": [numbers.facts(one) for numbers, one in zip(packed, parts, strict=True)],
    }
    model = GaussianModel([one.gaussians(own.gaussians) for one, own in zip(packed, parts, strict=True)])
    text = _page(printable(label), facts, [one.text() for one in packed])
    return Sent(text, model.drawn_by(drawn), sum(one.integers.nbytes for one in packed))


def _about(opened: Opened, parts: Sequence[Part]) -> dict[str, Any]:
    """As :meth:`.sources.Opened.about`, of what the page holds."""
    about = opened.about()
    palettes = {one.gaussians.name: one.palette for one in parts}
    scenes = [one | {"color": palettes[one["name"]]} for one in about["scenes"] if one["name"] in palettes]
    shown = [name for name in about["shown"] if name in palettes] or list(palettes)[:1]
    edits = opened.edits & (EDITS if any(palettes.values()) else EDITS - {"palette"})
    return about | {"scenes": scenes, "shown": shown, "edits": sorted(edits), "truth": False, "seconds": None}


_IMPORT = re.compile(r'^import \{([^}]+)\} from "\./([\w.]+)";$', re.MULTILINE)
_COMMENT = re.compile(r"/\*\*[\s\S]*?\*/ ?|^\s*//.*\n|^\s+", re.MULTILINE)
"""And indents: what a reader of the file does not need."""
_EXPORT = re.compile(r"^export ((?:async )?(?:function|class|const) (\w+))", re.MULTILINE)


_REPLACED = {"transfer.js": "export class Editor {body() {return {};} show() {}}\n"}
"""Module -> what takes its place: transfer functions are edited where the volume is."""


def _script(source: Mapping[str, str]) -> str:
    """All modules of the page as one script, for the window and its worker: each module is a function."""
    texts, order = {}, []

    def add(name: str) -> None:
        if name in texts:
            return
        text = _COMMENT.sub("", _REPLACED.get(name) or source["embedded.js" if name == "server.js" else name])
        texts[name] = text
        for needed in _IMPORT.findall(text):
            add(needed[1])
        order.append(name)

    for name in ("main.js", "splats.js"):
        add(name)
    functions = []
    for name in order:
        body = _IMPORT.sub(r'const {\1} = need("\2");', texts[name])
        names = ", ".join(match[1] for match in _EXPORT.findall(body))
        body = _EXPORT.sub(r"\1", body)
        functions.append(f'"{name}"() {{\n{body}\nreturn {{{names}}};\n}},')
    return (
        '"use strict";\nconst made = new Map(), modules = {\n' + "\n".join(functions) + "\n};\n"
        "function need(name) {\n  if (!made.has(name)) made.set(name, modules[name]());\n"
        "  return made.get(name);\n}\n"
        'need(globalThis.document ? "main.js" : "splats.js");\n'
    )


def _page(title: str, facts: Mapping[str, Any], data: Sequence[str]) -> str:
    """The file: no text of a model can end an element, and nothing but the page's own script runs."""
    page = files(__package__).joinpath("page")
    source = {one.name: one.read_text(encoding="utf-8") for one in page.iterdir() if one.is_file()}
    script, style = _script(source), source["style.css"]
    policy = (
        f"default-src 'none'; script-src '{_digest(script)}'; style-src '{_digest(style)}'; "
        "worker-src blob:; img-src blob: data:; base-uri 'none'; form-action 'none'"
    )
    # JSON, where only strings hold this letter.
    held = json.dumps(facts, allow_nan=False).replace("<", "\\u003c")
    blocks = [f'<script type="application/json" id="facts-held">{held}</script>']
    blocks += [f'<script type="text/plain" id="data-{n}">{one}</script>' for n, one in enumerate(data)]
    text = source["index.html"]
    for old, new in {
        '<meta charset="utf-8">': f'<meta charset="utf-8">\n<meta http-equiv="Content-Security-Policy" '
        f'content="{policy}">',
        _TITLE: f"<title>{html.escape(title)}</title>",
        '<link rel="stylesheet" href="style.css">': f"<style>{style}</style>",
        '<script type="module" src="main.js"></script>\n': "",
        "</body>": "\n".join([*blocks, f'<script id="code">{script}</script>', "</body>"]),
    }.items():
        before, found, after = text.partition(old)
        assert found, old
        text = before + new + after
    return text


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
