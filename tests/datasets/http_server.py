"""A local HTTP server whose answers a test chooses."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

CONTENT = bytes((i * i + 7 * i) % 251 for i in range(64**3))


class Server:
    """Serves ``content`` at every address.

    Attributes:
        content: the file.
        ranges: whether it honours the header Range.
        faults: of the next answers, in order: ("cut", bytes), ("code", number), ("redirect", url),
            ("more", bytes), ("chunked",), ("call", function).
        requests: (path, Range or None) of each request so far.
    """

    def __init__(self) -> None:
        self.content = CONTENT
        self.ranges = True
        self.faults: list[tuple] = []
        self.requests: list[tuple[str, str | None]] = []
        self.http = ThreadingHTTPServer(("127.0.0.1", 0), type("Handler", (_Handler,), {"owner": self}))

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.http.server_port}"


class _Handler(BaseHTTPRequestHandler):
    owner: Server
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        asked = self.headers.get("Range")
        self.owner.requests.append((self.path, asked))
        fault = self.owner.faults.pop(0) if self.owner.faults else ("none",)
        content = self.owner.content
        start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1]) if asked and self.owner.ranges else 0
        if fault[0] in ("code", "redirect"):
            self.send_response(302 if fault[0] == "redirect" else fault[1])
            if fault[0] == "redirect":
                self.send_header("Location", fault[1])
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        if start and start >= len(content):
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        body = content[start:]
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        if fault[0] == "chunked":
            self.send_header("Transfer-Encoding", "chunked")
            self.end_headers()
            self.wfile.write(b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body))
            return
        self.send_header("Content-Length", str(len(body)))
        if fault[0] == "headers":
            self.flush_headers()
            body = b"X-Long: " + body
        else:
            self.end_headers()
        if fault[0] in ("drip", "headers"):
            for byte in body:
                try:
                    self.wfile.write(bytes([byte]))
                except OSError:  # the client has gone
                    return
                time.sleep(fault[1])
        if fault[0] == "cut":
            body = body[: fault[1]]
        elif fault[0] == "call":
            fault[1]()
        self.wfile.write(body + (b"x" * fault[1] if fault[0] == "more" else b""))
        if fault[0] in ("cut", "more"):
            self.wfile.flush()
            self.connection.shutdown(socket.SHUT_RDWR)
            self.close_connection = True

    def log_message(self, *_: object) -> None:
        pass


@contextmanager
def serving() -> Iterator[Server]:
    """A running server."""
    server = Server()
    server.http.handle_error = lambda *_: None  # clients may go away
    thread = threading.Thread(target=server.http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.http.shutdown()
        server.http.server_close()
