"""The page's server: on this machine alone, one state for every tab, changes told by server-sent events."""

from __future__ import annotations

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Iterable, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from starlette.applications import Starlette
from starlette.requests import ClientDisconnect, Request
from starlette.responses import (
    FileResponse,
    HTMLResponse,
    JSONResponse,
    PlainTextResponse,
    Response,
    StreamingResponse,
)
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles

from trueflight.groundstation.reading.flight_file import is_flight_file
from trueflight.groundstation.workbench import uploads
from trueflight.groundstation.workbench.pages import Pages, progress
from trueflight.groundstation.workbench.session import PANELS, Session
from trueflight.groundstation.workbench.tasks import Source
from trueflight.groundstation.workbench.viewer import WebViewer
from trueflight.models.errors import InputError, plain_line

MOST_ASKED = 64 * 1024
"""Bytes of a request that is no file."""
HEARTBEAT = 15.0
"""s after which a silent tab is told that nothing is new, so that a lost one is seen."""
STATIC = Path(__file__).resolve().parent / "static"


@dataclass
class Workbench:
    """The application: its session, its pages, the tabs that listen, and the files dropped together."""

    session: Session
    pages: Pages
    viewer: WebViewer
    most_bytes: int = uploads.MOST_BYTES
    opened: tuple[Source, ...] = ()
    held_out: Source | None = None
    _tabs: set[asyncio.Queue[str]] = field(default_factory=set)
    _dropped: dict[str, list[uploads.Dropped]] = field(default_factory=dict)

    def app(self) -> Starlette:
        """The ASGI application."""
        posts = {
            "/drop": self._end_of_drop,
            "/vehicle": self._vehicle,
            "/choose": self._choose,
            "/remove": self._remove,
            "/add": self._add,
            "/stand": self._stand,
            "/beside": self._beside,
            "/plan": self._plan,
            "/cancel": self._cancel,
        }
        routes = [
            Route("/", self._page),
            Route("/events", self._events),
            Route("/panels/{name}", self._panel),
            Route("/results/{name}", self._result),
            Route("/upload", self._upload, methods=["POST"]),
            Route("/viewer", self._viewer_page),
            Route("/viewer/{name}", self._viewer_file),
            *(Route(path, _asked(answer), methods=["POST"]) for path, answer in posts.items()),
            Mount("/static", StaticFiles(directory=STATIC)),
        ]
        return Starlette(routes=routes, lifespan=self._lifespan)

    @asynccontextmanager
    async def _lifespan(self, app: Starlette) -> AsyncIterator[None]:
        loop = asyncio.get_running_loop()

        def on_the_loop(call: Callable[[], None]) -> None:
            if not loop.is_closed():
                loop.call_soon_threadsafe(call)

        self.session.open(on_the_loop)
        for source in self.opened:
            self.session.add_flight(source)
        if self.held_out is not None:
            self.session.add_flight(self.held_out, held_out=True)
        try:
            yield
        finally:
            self.session.close()

    def changed(self, panels: Iterable[str]) -> None:
        """Tell every tab what has changed."""
        told = json.dumps({"panels": self.session.revisions, "progress": progress(self.session)})
        for tab in self._tabs:
            tab.put_nowait(told)

    # --- what is looked at ----------------------------------------------------------------------------------------

    async def _page(self, request: Request) -> Response:
        return HTMLResponse(self.pages.whole(self.session))

    async def _panel(self, request: Request) -> Response:
        name = request.path_params["name"]
        if name not in PANELS:
            return PlainTextResponse("no such panel\n", 404)
        revision = str(self.session.revisions[name])
        return HTMLResponse(self.pages.panel(self.session, name), headers={"X-Revision": revision})

    async def _events(self, request: Request) -> Response:
        async def stream() -> AsyncIterator[str]:
            tab: asyncio.Queue[str] = asyncio.Queue()
            self._tabs.add(tab)
            try:
                told = {"panels": self.session.revisions, "progress": progress(self.session)}
                yield f"data: {json.dumps(told)}\n\n"
                while True:
                    try:
                        yield f"data: {await asyncio.wait_for(tab.get(), HEARTBEAT)}\n\n"
                    except TimeoutError:
                        yield ": still here\n\n"
            finally:
                self._tabs.discard(tab)

        return StreamingResponse(stream(), media_type="text/event-stream")

    async def _result(self, request: Request) -> Response:
        """A file that was written for the page: one of those that its parts name, and no other."""
        name = request.path_params["name"]
        files = {p.name: p for part in self.session.state.parts.values() for p in part.files.values()}
        if name not in files or not files[name].is_file():
            return PlainTextResponse("no such result\n", 404)
        return FileResponse(files[name], filename=name, content_disposition_type="attachment")

    async def _viewer_page(self, request: Request) -> Response:
        return HTMLResponse(self.pages.viewer(request.query_params.get("recording", "")))

    async def _viewer_file(self, request: Request) -> Response:
        try:
            path = await asyncio.to_thread(self.viewer.file, request.path_params["name"])
        except InputError as error:
            return PlainTextResponse(f"{plain_line(str(error))}\n", 404)
        kept = {"Cache-Control": "private, max-age=86400"}
        return FileResponse(path, media_type=self.viewer.media_type(path.name), headers=kept)

    # --- what is asked --------------------------------------------------------------------------------------------

    async def _upload(self, request: Request) -> Response:
        """One file, as it is; its name and what it was dropped with stand in the headers."""
        name = unquote(request.headers.get("x-name", ""))
        batch = request.headers.get("x-batch", "")[:40]
        try:
            length = request.headers.get("content-length", "")
            if length.isdecimal() and int(length) > self.most_bytes:
                raise uploads.too_large(name, self.most_bytes)
            folder = self.session.folder / "dropped"
            stored = await uploads.store(name, request.stream(), folder, self.most_bytes)
        except InputError as error:
            return JSONResponse({"problem": plain_line(str(error))}, 422)
        except ClientDisconnect:
            return Response(status_code=499)
        except OSError as error:
            return JSONResponse({"problem": f"{error.strerror}; free space, or check the permissions"}, 507)
        self._dropped.setdefault(batch, []).append(stored)
        return JSONResponse({"name": stored.name})

    def _end_of_drop(self, asked: Mapping[str, Any]) -> None:
        """All files of one drop are there: its flights, each with the files that go with it."""
        files = self._dropped.pop(str(asked.get("batch", "")), [])
        flights = [d for d in files if not d.path.name.endswith(uploads.SIDECARS) and is_flight_file(d.path)]
        if files and not flights:
            raise InputError(
                "no flight among these files: a vehicle or a mapping goes with a flight, drop them together"
            )
        for one in sorted(flights, key=lambda dropped: dropped.name):
            vehicle, mapping = (uploads.beside(one, files, kind) for kind in uploads.SIDECARS)
            self.session.add_flight(Source(one.path, one.name, vehicle, mapping))

    def _vehicle(self, asked: Mapping[str, Any]) -> None:
        texts = asked.get("values")
        if not isinstance(texts, dict):
            raise InputError("no values")
        self.session.set_vehicle(_number(asked, "flight"), {str(k): str(v) for k, v in texts.items()})

    def _choose(self, asked: Mapping[str, Any]) -> None:
        self.session.choose(_number(asked, "fitted"), _number(asked, "held_out"))

    def _remove(self, asked: Mapping[str, Any]) -> None:
        self.session.remove_flight(_number(asked, "flight"))

    def _add(self, asked: Mapping[str, Any]) -> None:
        self.session.add(_words(asked, "effects"))

    def _stand(self, asked: Mapping[str, Any]) -> None:
        self.session.stand_at(str(asked.get("version", "")))

    def _beside(self, asked: Mapping[str, Any]) -> None:
        flights = [int(word) for word in _words(asked, "flights") if word.isdecimal()]
        self.session.beside(flights, _words(asked, "models"))

    def _plan(self, asked: Mapping[str, Any]) -> None:
        self.session.plan(_words(asked, "between"))

    def _cancel(self, asked: Mapping[str, Any]) -> None:
        self.session.cancel()


def _asked(answer: Any) -> Any:
    """A route that takes a small JSON object; what cannot be done is one line of JSON."""

    async def route(request: Request) -> Response:
        if request.headers.get("content-type", "").partition(";")[0] != "application/json":
            return JSONResponse({"problem": "this page asks in JSON"}, 415)
        body = b""
        async for piece in request.stream():
            body += piece
            if len(body) > MOST_ASKED:
                return JSONResponse({"problem": "too much at once"}, 413)
        try:
            asked = json.loads(body)
            if not isinstance(asked, dict):
                raise InputError("this page asks in JSON objects")
            answer(asked)
        except InputError as error:
            return JSONResponse({"problem": plain_line(str(error))}, 409)
        except (ValueError, RecursionError):
            return JSONResponse({"problem": "this is no JSON"}, 400)
        return JSONResponse({})

    return route


def _number(asked: Mapping[str, Any], key: str) -> int:
    value = str(asked.get(key) or "0")
    if not value.isdecimal() or len(value) > 9:
        raise InputError(f"{key}: no number")
    return int(value)


def _words(asked: Mapping[str, Any], key: str) -> list[str]:
    value = asked.get(key, [])
    if (
        not isinstance(value, list)
        or not all(isinstance(v, str) and len(v) < 80 for v in value)
        or len(value) > 40
    ):
        raise InputError(f"{key}: no list of names")
    return value
