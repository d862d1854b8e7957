"""Pages as PDF, by WeasyPrint; nothing is loaded from anywhere."""

from __future__ import annotations

import logging
import re
from pathlib import Path

from suspnet.ground.extras import check_extra
from suspnet.ground.storage import write_atomically

PAGE = """
@page { size: A4; margin: 14mm 12mm 16mm;
  @bottom-right { content: counter(page) " / " counter(pages); font: 8pt sans-serif; } }
@page wide { size: A4 landscape; }
#trips, #trips + .scroll { page: wide; }
"""
"""Paper: the table of trips has many columns and is printed across."""


def as_pdf(html: str) -> bytes:
    """Return a page that holds all its styles and pictures as PDF.

    Addresses other than data URIs are not followed: the page may hold what others wrote. ValueError
    is raised if WeasyPrint is missing.
    """
    check_extra("pdf", "weasyprint")
    # steps, also of the import, and names of unknown styles
    for name in ("weasyprint", "weasyprint.progress", "fontTools"):
        logging.getLogger(name).setLevel(logging.ERROR)
    import weasyprint
    from weasyprint.urls import URLFetcher

    only_data = URLFetcher(allowed_protocols=["data"])
    page = weasyprint.HTML(string=_styled(html), url_fetcher=only_data)
    content: bytes = page.write_pdf(stylesheets=[weasyprint.CSS(string=PAGE)])
    return content


def write_pdf(page: Path) -> Path:
    """Write a page of a report next to it as PDF, atomically; return its path."""
    return write_atomically(page.with_suffix(".pdf"), as_pdf(page.read_text(encoding="utf-8")))


def _styled(html: str) -> str:
    """Return a page whose drawings hold the page's styles, as WeasyPrint draws them alone."""
    element = re.search(r"<style>(.*?)</style>", html, re.S)
    if element is None:
        return html
    styles = element[1]
    for name, value in re.findall(r"(--[\w-]+):\s*([^;}]+)", styles):
        styles = re.sub(rf"var\({name}(?:,[^)]*)?\)", value.strip(), styles)
    rules = re.findall(r"^svg\.bogie[^{]*\{[^}]*\}", styles, re.M)
    own = "<style>" + "\n".join(rules) + "</style>"
    return re.sub(r'(<svg class="bogie"[^>]*>)', rf"\g<1>{own}", html)
