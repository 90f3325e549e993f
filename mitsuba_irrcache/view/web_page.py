"""The page that the viewer serves: viser's client with title, icon and components of our own."""

from __future__ import annotations

import gzip
import http
import re
from collections.abc import Mapping
from functools import cache
from html import escape
from pathlib import Path
from urllib.parse import quote

import viser
from websockets.datastructures import Headers
from websockets.http11 import Response

FOLDER = Path(__file__).with_name("page")
#: How the script of viser's client begins, and what keeps browsers from running it at once: it uses
#: a processor for a second, in which `overlay.js` shows the first image. Then it is started.
CLIENT, DEFERRED = "<script data-p=", '<script type="text/viser" data-p='
SCRIPTS = ("channel.js", "transfer.js", "light.js", "background.js", "overlay.js")


@cache
def _page(title: str) -> bytes:
    """Return the page as gzipped HTML."""
    client = Path(viser.__file__).parent / "client" / "build" / "index.html"
    text = client.read_text(encoding="utf-8")
    icon = quote((FOLDER / "icon.svg").read_text(encoding="utf-8"))
    style = (FOLDER / "viewer.css").read_text(encoding="utf-8")
    script = "\n".join((FOLDER / name).read_text(encoding="utf-8") for name in SCRIPTS)
    head = (
        f'<title>{escape(title)}</title><link rel="icon" href="data:image/svg+xml,{icon}">'
        f"<style>{style}</style><script>{script}</script>"
    )
    text = re.sub(r'<link\s+rel="icon".*?>', "", text, count=1, flags=re.DOTALL)
    text = re.sub(r"<title>.*?</title>", lambda _: head, text, count=1)
    text = text.replace(CLIENT, DEFERRED, 1)
    return gzip.compress(text.encode())


def page(title: str, headers: Mapping[str, str]) -> Response:
    """Return the response to a request for the page."""
    body, encoding = _page(title), "gzip"
    if "gzip" not in headers.get("Accept-Encoding", ""):
        body, encoding = gzip.decompress(body), "identity"
    fields = {
        "Content-Type": "text/html; charset=utf-8",
        "Content-Length": str(len(body)),
        "Content-Encoding": encoding,
    }
    return Response(http.HTTPStatus.OK.value, "OK", Headers(fields), body)
