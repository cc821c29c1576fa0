"""What mkdocs.yml does not say: pages of the reference and of the notebooks, and formulas as MathML.

MathML needs no script, and browsers draw it since 2023. mkdocs calls the functions `on_...`.
"""

from __future__ import annotations

import html
import json
import re
from pathlib import Path
from typing import Any

FORMULA = re.compile(r'<(?P<tag>div|span) class="arithmatex">\\[(\[](?P<latex>.*?)\\[)\]]</(?P=tag)>', re.S)
# Sections of our docstrings that mkdocstrings takes for paragraphs, and their names of pages.
SECTION = re.compile(r"<p>(Convention|Cost|Source|Ties|Warns|Example): ")
PAGE = re.compile(r"(?<![\w/\"])docs/(\w+)\.md(?!\")")
STYLE = ".md-grid { max-width: 76rem; }\n"


def on_files(files: Any, config: Any) -> Any:
    """Add the pages of the reference, and replace each notebook by a page with its text, code and outputs."""
    from mkdocs.structure.files import File

    files.append(File.generated(config, "site.css", content=STYLE))
    for name, (title, *names) in config.extra["reference"].items():
        text = "\n\n".join([f"# {title}", *(f"::: {each}" for each in names)])
        files.append(File.generated(config, f"reference/{name}.md", content=text))
    for file in list(files):
        if file.src_uri.endswith(".ipynb"):
            files.remove(file)
            page = notebook_page(Path(str(file.abs_src_path)))
            files.append(File.generated(config, file.src_uri.replace(".ipynb", ".md"), content=page))
    return files


def notebook_page(path: Path) -> str:
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        source = "".join(cell["source"])
        parts.append(source if cell["cell_type"] == "markdown" else f"```python\n{source}\n```")
        for output in cell.get("outputs", ()):
            kinds = output.get("data", {"text/plain": output.get("text")})  # printed text has no kinds
            data = {kind: "".join(value) for kind, value in kinds.items()}
            if "image/png" in data:
                parts.append(f"![output](data:image/png;base64,{data['image/png'].strip()})")
            elif data.get("text/html", "").startswith("<iframe"):  # Markdown ends HTML at an empty line
                parts.append(data["text/html"].replace("\n", "&#10;"))
            else:
                parts.append(f"```text\n{data['text/plain'].rstrip()}\n```")
    return "\n\n".join(parts)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Link to the page of a notebook instead of its file."""
    return re.sub(r"(\]\([\w./]+)\.ipynb\)", r"\1.md)", markdown)


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """Draw formulas. In the reference, print the names of our sections in bold, and link the pages that it names."""
    if page.file.src_uri.startswith("reference/"):
        html = SECTION.sub(r"<p><strong>\1:</strong> ", html)
        html = PAGE.sub(r'<a href="../docs/\1.html">docs/\1.md</a>', html)
    return FORMULA.sub(_math, html)


def _math(found: re.Match[str]) -> str:
    from latex2mathml.converter import convert

    return convert(html.unescape(found["latex"]), display="block" if found["tag"] == "div" else "inline")
