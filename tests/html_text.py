"""Text of an HTML page, for tests that compare its content."""

import re
from html.parser import HTMLParser


class _Texts(HTMLParser):
    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.found: list[str] = []
        self._in_style = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self._in_style = tag == "style"

    def handle_endtag(self, tag: str) -> None:
        self._in_style = False

    def handle_data(self, data: str) -> None:
        if data.strip() and not self._in_style:
            self.found.append(re.sub(r"\s+", " ", data).strip())


def texts(html: str) -> list[str]:
    """Pieces of text between tags, in order, without style sheets; white space is folded."""
    parser = _Texts()
    parser.feed(html)
    parser.close()
    return parser.found
