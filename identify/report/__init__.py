"""Reports for people: one HTML file with figures, the figures alone, a summary in plain text."""

from identify.report.build import html, write_html
from identify.report.gallery import figures, save_figures

__all__ = ["figures", "html", "save_figures", "write_html"]
