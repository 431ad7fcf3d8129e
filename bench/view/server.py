"""The server of the page: one address on this machine, with a token, for one page at a time or several.

Everything lies under ``/TOKEN/``: the files of the page, and the routes of :data:`ROUTES`, which take JSON
and give JSON, or JSON and numbers (:class:`Numbers`). Requests that name another host, or come from another
origin, are refused.
"""

from __future__ import annotations

import errno
import hashlib
import hmac
import json
import re
import secrets
import struct
import sys
from collections.abc import Callable, Mapping, Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from econgs_bench.bench.suites.edits import parse_edits, toml_of
from econgs_bench.bench.view.sources import Edits, Opened, Source
from econgs_bench.datasets.bounded import json_of
from econgs_bench.datasets.camera import Camera
from econgs_bench.datasets.errors import DataError, printable, text_of
from econgs_bench.datasets.scene import RGB

if TYPE_CHECKING:
    from econgs_bench.datasets.catalogue.editing import Editable

HOST = "127.0.0.1"
TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
LONGEST = 1 << 20
"""Bytes of a request."""
SAVED = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,95}\.toml")
"""Names of files that the page may write."""
LARGEST = 2048
"""Pixels along a side of a picture."""
POLICY = (
    "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; connect-src 'self'; "
    "img-src 'self' blob: data:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS = {
    "Content-Security-Policy": POLICY,
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Numbers:
    """Facts, and arrays of numbers after them: what takes too long as JSON.

    On the wire: the length of the facts (4 bytes, little-endian), the facts, spaces up to a multiple of 8,
    and the arrays one after the other, each padded to 8 bytes.

    Args:
        facts: JSON values; ``arrays`` is added: name -> offset in bytes, type and shape.
        arrays: float32, float16 or uint8.
    """

    def __init__(self, facts: Mapping[str, Any], **arrays: NDArray[Any]) -> None:
        self.facts, self.arrays = facts, {name: np.ascontiguousarray(one) for name, one in arrays.items()}

    def bytes(self) -> bytes:
        """All of it."""
        offset, places = 0, {}
        for name, one in self.arrays.items():
            places[name] = [offset, one.dtype.name, list(one.shape)]
            offset += -(-one.nbytes // 8) * 8
        head = json.dumps({**self.facts, "arrays": places}).encode()
        head += b" " * (-(len(head) + 4) % 8)
        parts = [struct.pack("<I", len(head)), head]
        for one in self.arrays.values():
            parts += [one.tobytes(), b"\0" * (-one.nbytes % 8)]
        return b"".join(parts)


Reply = Mapping[str, Any] | Numbers


class Viewer:
    """What the page asks for.

    Args:
        sources: what can be looked at, at least one.

    Attributes:
        folder: in which scenes are saved: where the command was started.
    """

    def __init__(self, sources: Sequence[Source]) -> None:
        self.sources = tuple(sources)
        self.folder = Path.cwd().resolve()

    def about(self, body: Mapping[str, Any]) -> Reply:
        """Labels of all sources, and the color scale of differences."""
        from econgs_bench.reports.pictures.difference import DELTA_E_MAX, scale

        labels = [printable(source.label) for source in self.sources]
        return {"sources": labels, "scale": scale().ravel().tolist(), "most": DELTA_E_MAX}

    def open(self, body: Mapping[str, Any]) -> Reply:
        """One source: its scenes, cameras, and what can be done with it."""
        source, _ = self._source(body)
        return {**source.about(), "label": printable(self.sources[int(body["source"])].label)}

    def splats(self, body: Mapping[str, Any]) -> Reply:
        """The Gaussians of a view: means, quaternions, scales, opacities and colors.

        Of the first four only their ``key``, where the page says that it has them.
        """
        source, scenes = self._source(body)
        own = source.splats(_camera(body), scenes, _edits(body, scenes))
        low = own.low_pass
        facts = {
            "variance": low.variance,
            "compensated": low.compensated,
            "rayPower": low.ray_power,
            "points": low.points,
        }
        names = ("means", "quats", "scales", "opacities")
        shapes = {name: np.ascontiguousarray(getattr(own, name).cpu().numpy()) for name in names}
        key = hashlib.blake2b(b"".join(one.data for one in shapes.values()), digest_size=16).hexdigest()
        colors = own.features.cpu().numpy()
        known = {} if body.get("has") == key else shapes
        return Numbers({**facts, "key": key}, colors=colors, **known)

    def picture(self, body: Mapping[str, Any]) -> Reply:
        """A picture that is drawn here; of the truth with one ray a pixel if ``coarse``."""
        from econgs_bench.bench.jobs.measure import premultiplied

        source, scenes = self._source(body)
        samples, background = 1 if body.get("coarse") else None, _background(body)
        rgb, alpha = source.picture(_camera(body), scenes, _edits(body, scenes), background, samples)
        return _pixels({}, premultiplied(rgb, alpha, background))

    def truth(self, body: Mapping[str, Any]) -> Reply:
        """The ground truth of a view, and by the harness's metrics what the source's own picture reaches."""
        from econgs_bench.bench.metrics import evaluate

        source, scenes = self._source(body)
        camera, edits, background = _camera(body), _edits(body, scenes), _background(body)
        coarse = bool(body.get("coarse"))
        truth = source.truth(camera, scenes, edits, 1 if coarse else None)
        scores = None
        if source.model is not None:
            camera = camera.resized(truth.shape[1], truth.shape[0])
            rgb, alpha = source.picture(camera, scenes, edits, background, None)
            scores = evaluate(truth, rgb, alpha, background, SCORES[:1] if coarse else SCORES).values
        return _pixels({"scores": scores}, truth)

    def edit(self, body: Mapping[str, Any]) -> Reply:
        """The text of a file that `bench render --edit` reads, after a check of what it says."""
        _, scenes = self._source(body)
        return {"text": toml_of(_edits(body, scenes))}

    def histogram(self, body: Mapping[str, Any]) -> Reply:
        """How often values, and gradients of them, occur in a variable (:class:`.Histogram`)."""
        counts, density, ends = self._editable(body).histogram(str(body["variable"]))
        return Numbers({"range": ends}, counts=counts, density=density)

    def propose(self, body: Mapping[str, Any]) -> Reply:
        """Scenes of a variable as `bench scenes` proposes them."""
        return {"tables": self._editable(body).proposed(str(body["variable"]))}

    def save(self, body: Mapping[str, Any]) -> Reply:
        """Write the scenes with their edits as a TOML file; ``over``: it may replace one."""
        from econgs_bench.datasets.edits import edited

        name, editable = str(body["name"]), self._editable(body)
        if not SAVED.fullmatch(name):
            remedy = "Give letters, digits, _ . and -, with the suffix .toml: it is saved where you started"
            raise DataError(printable(name), "is no name of a file", remedy)
        path = self.folder / name
        if path.exists() and not body.get("over"):
            return {"exists": True}
        tables, scenes = editable.checked(body["tables"]), editable.scenes(body["tables"])
        edits = _edits(body, [scene.name for scene in scenes])
        kept = [one for one in tables if one["name"] not in edits]
        parts = [edited(one, edits[one.name]) if one.name in edits else one for one in scenes]
        text = editable.write(parts, kept, path, over=bool(body.get("over")))
        return {"text": text, "path": printable(str(path)), "command": f"bench run quick --dataset {name}"}

    def _editable(self, body: Mapping[str, Any]) -> Editable:
        """The scenes of a source that can be edited."""
        source, _ = self._source({"source": body["source"]})
        if source.editable is None:
            raise DataError("this source", "has no transfer functions to edit", "View a volume or a dataset")
        return source.editable

    def _source(self, body: Mapping[str, Any]) -> tuple[Opened, list[str]]:
        """A source, and the scenes of it that are shown."""
        place = body["source"]
        if not isinstance(place, int) or not 0 <= place < len(self.sources):
            raise DataError("this request", f"there is no source {place!r}", "Load the page again")
        source = self.sources[place].open()
        if "tables" in body:
            source = source.defined(body["tables"])
        scenes = [name for name in source.scenes if name in body.get("scenes", source.scenes)]
        if not scenes:
            raise DataError("no scene", "is switched on", "Switch one on")
        return source, scenes


SCORES = ("psnr", "ssim", "delta_e_uv")
ROUTES: dict[str, Callable[[Viewer, Mapping[str, Any]], Reply]] = {
    "about": Viewer.about,
    "open": Viewer.open,
    "splats": Viewer.splats,
    "picture": Viewer.picture,
    "truth": Viewer.truth,
    "edit": Viewer.edit,
    "histogram": Viewer.histogram,
    "propose": Viewer.propose,
    "save": Viewer.save,
}
"""Name of a route, asked for by POST with a JSON object -> its answer."""


def _edits(body: Mapping[str, Any], scenes: Sequence[str]) -> Edits:
    """Edits of the scenes that are shown."""
    edits = parse_edits(str(text) for text in body.get("edits", ()))
    return {name: edit for name, edit in edits.items() if name in scenes}


def _camera(body: Mapping[str, Any]) -> Camera:
    """The camera of a request.

    Raises:
        ValueError, TypeError, KeyError: it is none.
    """
    about = body["camera"]
    matrix = np.array(about["matrix"], dtype=np.float64).reshape(4, 4)
    fx, fy, cx, cy, near = (float(about[name]) for name in ("fx", "fy", "cx", "cy", "near"))
    width, height = int(about["width"]), int(about["height"])
    turn = matrix[:3, :3]
    if not (
        np.isfinite([*matrix.ravel(), fx, fy, cx, cy, near]).all()
        and np.abs(turn @ turn.T - np.eye(3)).max() < 1e-6
        and min(fx, fy, near) > 0.0
        and 1 <= min(width, height) <= max(width, height) <= LARGEST
    ):
        raise ValueError("the camera is out of range")
    return Camera(matrix, fx, fy, cx, cy, width, height, near=near)


def _background(body: Mapping[str, Any]) -> RGB:
    """The background of a request."""
    red, green, blue = (float(value) for value in body["background"])
    if not (min(red, green, blue) >= 0.0 and max(red, green, blue) <= 1.0):
        raise ValueError("the background is no color")
    return red, green, blue


def _pixels(facts: Mapping[str, Any], picture: NDArray[np.float32]) -> Numbers:
    height, width = picture.shape[:2]
    return Numbers({**facts, "width": width, "height": height}, pixels=picture.astype(np.float16))


class Server(ThreadingHTTPServer):
    """Listens on this machine alone.

    Args:
        viewer: answers the routes.
        port: 0: any free one.

    Raises:
        DataError: the port is in use, or not allowed.
    """

    daemon_threads = True
    allow_reuse_address = sys.platform != "win32"

    def __init__(self, viewer: Viewer, port: int = 0) -> None:
        self.viewer, self.token = viewer, secrets.token_urlsafe(18)
        page = files(__package__).joinpath("page")
        self.page = {one.name: one.read_bytes() for one in page.iterdir() if Path(one.name).suffix in TYPES}
        try:
            super().__init__((HOST, port), Handler)
        except OverflowError as error:
            raise DataError(
                f"--port {port}", "is none", "Give one from 1 to 65535, or leave it out"
            ) from error
        except OSError as error:
            reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise DataError(f"--port {port}", reason, "Give another, or leave it out") from error
        self.hosts = {f"{name}:{self.server_port}" for name in (HOST, "localhost")}

    @property
    def address(self) -> str:
        """What a browser opens."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A page that was closed amid an answer is no news."""
        if not isinstance(sys.exception(), ConnectionError):
            super().handle_error(request, client_address)


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    server: Server
    server_version = "econgs-bench"
    sys_version = ""
    protocol_version = "HTTP/1.1"
    timeout = 60.0
    disable_nagle_algorithm: ClassVar[bool] = True

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing is printed for each request."""

    def do_GET(self) -> None:
        """The files of the page."""
        name = self._name()
        if name is None:
            return
        data = self.server.page.get(name or "index.html")
        if data is None:
            self._refuse(HTTPStatus.NOT_FOUND, "no such file")
            return
        self._send(HTTPStatus.OK, data, TYPES[Path(name or "index.html").suffix] + "; charset=utf-8")

    def do_POST(self) -> None:
        """A route."""
        name = self._name()
        if name is None:
            return
        length = self.headers.get("Content-Length", "")
        if self.headers.get_content_type() != "application/json" or not length.isdecimal():
            self._refuse(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "JSON is asked for")
            return
        if int(length) > LONGEST or name not in ROUTES:
            self._refuse(HTTPStatus.NOT_FOUND, "no such route, or too much of a request")
            return
        status, reply = self._answer(name, self.rfile.read(int(length)))
        if isinstance(reply, Numbers):
            self._send(status, reply.bytes(), "application/octet-stream")
        else:
            self._send(status, json.dumps(reply).encode(), "application/json")

    def _answer(self, name: str, data: bytes) -> tuple[HTTPStatus, Reply]:
        try:
            body = json_of(data, most=10_000)
            if not isinstance(body, dict):
                raise TypeError("the request is no object")
            return HTTPStatus.OK, ROUTES[name](self.server.viewer, body)
        except DataError as error:
            return HTTPStatus.BAD_REQUEST, {"error": printable(str(error))}
        except (ValueError, TypeError, KeyError) as error:
            return HTTPStatus.BAD_REQUEST, {"error": f"this request cannot be used ({text_of(error)})"}
        except MemoryError:
            return HTTPStatus.INTERNAL_SERVER_ERROR, {"error": "not enough memory for this picture"}

    def _name(self) -> str | None:
        """What a request asks for below the token; None: refused, and told so."""
        origin = self.headers.get("Origin")
        if self.headers.get("Host") not in self.server.hosts or (
            origin is not None and origin.removeprefix("http://") not in self.server.hosts
        ):
            self._refuse(HTTPStatus.FORBIDDEN, "another host or origin")
            return None
        token, slash, name = self.path.removeprefix("/").partition("?")[0].partition("/")
        if not (hmac.compare_digest(token.encode(), self.server.token.encode()) and slash):
            self._refuse(HTTPStatus.NOT_FOUND, "open the address that `bench view` printed")
            return None
        return name

    def _refuse(self, status: HTTPStatus, why: str) -> None:
        self.close_connection = True
        length = self.headers.get("Content-Length", "")
        if length.isdecimal():  # what is left unread would reset the connection before the answer arrives
            self.rfile.read(min(int(length), 4 * LONGEST))
        self._send(status, json.dumps({"error": why}).encode(), "application/json")

    def _send(self, status: HTTPStatus, data: bytes, kind: str) -> None:
        self.send_response(status)
        for header, value in HEADERS.items():
            self.send_header(header, value)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(data)))
        if self.close_connection:
            self.send_header("Connection", "close")
        self.end_headers()
        self.wfile.write(data)
