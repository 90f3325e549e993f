"""The package's description: README.md with links that lead somewhere outside the repository.

Everything else about the package is in pyproject.toml.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from setuptools import setup

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

HERE = Path(__file__).parent
#: Links and images whose target is neither an address nor a heading of the page.
IMAGE = re.compile(r"!\[([^\]]*)\]\((?!https?:|#)([^)]+)\)")
LINK = re.compile(r"(?<!!)\[([^\]]*)\]\((?!https?:|#)([^)]+)\)")


def description(readme: str, source: str) -> str:
    """Return a README in which relative links and images have become absolute.

    ``source`` is the address of the repository. Without one, relative images and their captions are
    left out and relative links become plain text, since they would lead nowhere.
    """
    if source:
        readme = IMAGE.sub(rf"![\1]({source.rstrip('/')}/raw/main/\2)", readme)
        return LINK.sub(rf"[\1]({source.rstrip('/')}/blob/main/\2)", readme)
    readme = re.sub(rf"{IMAGE.pattern}\n\n(\*[^*\n]+\*\n\n)?", "", readme)
    return LINK.sub(r"\1", readme)


def main() -> None:
    """Hand over what pyproject.toml declares as dynamic and setuptools cannot compute."""
    project = tomllib.loads((HERE / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    readme = (HERE / "README.md").read_text(encoding="utf-8")
    setup(
        long_description=description(readme, project.get("urls", {}).get("Source", "")),
        long_description_content_type="text/markdown",
    )


if __name__ == "__main__":
    main()
