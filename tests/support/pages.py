"""Pages that the package writes, read back."""

import base64
import json
from html.parser import HTMLParser
from typing import Any

import numpy as np


class Page(HTMLParser):
    """Checks that tags close and collects text, links and identifiers."""

    def __init__(self, content: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.text: list[str] = []
        self.links: list[str] = []
        self.identifiers: list[str] = []
        self.data: dict[str, Any] = {}
        self.feed(content)

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "br", "link", "input"):
            self.open.append(tag)
        self._attributes(attrs)

    def handle_startendtag(self, tag, attrs):
        self._attributes(attrs)

    def _attributes(self, attrs):
        self.links += [value for name, value in attrs if name in ("src", "href", "xlink:href")]
        self.identifiers += [value for name, value in attrs if name == "id"]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("script", "style"):
            if data.startswith('{"seconds"'):
                self.data = json.loads(data)
            return
        self.text.append(data)

    @property
    def words(self) -> str:
        return " ".join(" ".join(self.text).split())

    def plot(self, title: str) -> dict[str, Any]:
        return next(plot for plot in self.data["plots"] if plot["title"].startswith(title))

    def values(self, title: str, label: str) -> np.ndarray:
        """The numbers of a series in a plot."""
        return unpack(next(each for each in self.plot(title)["series"] if each["label"] == label)["values"])


def unpack(packed: dict[str, str], *shape: int) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed["base64"]), packed["dtype"]).reshape(-1, *shape)
