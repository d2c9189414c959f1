"""A page of HTML from parts: text, tables, figures, sections, and the style sheet.

Everything that comes from outside (names of runs, titles, reasons) passes `text`, which escapes
it. The result is one file without script or network address; it follows the reader's light or
dark setting and prints on A4.
"""

from collections.abc import Iterable, Sequence
from html import escape

from matplotlib.figure import Figure

from identify.report.theme import DARK, INK, to_svg


def text(value: object) -> str:
    return escape(str(value))


def tag(name: str, *content: str, **attributes: str) -> str:
    """One element; `content` is HTML already. A trailing underscore in a name is dropped."""
    own = "".join(f' {k.rstrip("_")}="{text(v)}"' for k, v in attributes.items())
    return f"<{name}{own}>{''.join(content)}</{name}>"


def table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    caption: str = "",
    numeric: Sequence[int] = (),
) -> str:
    """A table of plain values; columns of `numeric` are set flush right."""

    def cell(kind: str, i: int, value: object) -> str:
        return tag(kind, text(value), **({"class_": "n"} if i in numeric else {}))

    def row(values: Sequence[object]) -> str:
        return tag("tr", *(cell("td", i, v) for i, v in enumerate(values)))

    top = tag("tr", *(cell("th", i, h) for i, h in enumerate(head)))
    note = tag("p", text(caption), class_="note") if caption else ""
    body = tag("tbody", *(row(r) for r in rows))
    return tag("div", tag("table", tag("thead", top), body), class_="scroll") + note


def drawing(figure: Figure, name: str, caption: str) -> str:
    """A figure with its caption; the caption is also what a screen reader says."""
    svg = to_svg(figure, name).replace("<svg ", f'<svg role="img" aria-label="{text(caption)}" ', 1)
    return tag("figure", svg, tag("figcaption", text(caption)), id=name)


def section(title: str, *content: str) -> str:
    body = [c for c in content if c]
    return tag("section", tag("h2", text(title)), *body) if body else ""


def paragraphs(lines: Iterable[str]) -> str:
    return "".join(tag("p", text(line)) for line in lines)


def page(title: str, *content: str) -> str:
    head = (
        '<meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta name="color-scheme" content="light dark">'
        f"<title>{text(title)}</title><style>{STYLE}</style>"
    )
    return (
        f'<!doctype html><html lang="en"><head>{head}</head>'
        f"<body><main>{''.join(content)}</main></body></html>\n"
    )


def _variables(palette: dict[str, str]) -> str:
    return "".join(f"--{name}:{colour};" for name, colour in palette.items())


STYLE = f"""
:root{{{_variables(INK)}--tint:#f4f6f8}}
@media screen and (prefers-color-scheme:dark){{:root{{{_variables(DARK)}--tint:#1e2227}}}}
*{{box-sizing:border-box}}
body{{margin:0;background:var(--paper);color:var(--ink);
font:15px/1.5 system-ui,"Segoe UI","DejaVu Sans",sans-serif}}
main{{max-width:56rem;margin:0 auto;padding:1.5rem 1rem 4rem}}
h1{{font-size:1.5rem;line-height:1.25;margin:.3rem 0 .6rem}}
h2{{font-size:1.12rem;margin:2.2rem 0 .5rem;padding-top:.6rem;border-top:1px solid var(--grid)}}
h3{{font-size:1rem;margin:1.2rem 0 .3rem}}
p{{margin:.4rem 0;max-width:46rem}}
.over{{color:var(--muted);font-size:.9rem;margin:0}}
.verdict{{border-left:.35rem solid var(--muted);background:var(--tint);
padding:.7rem 1rem;margin:.8rem 0}}
.verdict.no_discrepancy,.verdict.traced,.verdict.identified{{border-color:var(--good)}}
.verdict.ambiguous,.verdict.unexplained{{border-color:var(--before)}}
.verdict h1{{margin:0 0 .3rem}}
.scroll{{overflow-x:auto}}
table{{border-collapse:collapse;margin:.6rem 0;font-size:.88rem;font-variant-numeric:tabular-nums}}
.note{{color:var(--muted);font-size:.85rem;max-width:50rem}}
th,td{{text-align:left;padding:.22rem .8rem .22rem 0;border-bottom:1px solid var(--grid);
vertical-align:top}}
th{{font-weight:600}}
.n{{text-align:right;white-space:nowrap}}
figure{{margin:1rem 0;break-inside:avoid}}
figure svg{{width:100%;height:auto;display:block}}
figure svg text{{fill:var(--ink)}}
figcaption{{color:var(--muted);font-size:.85rem;margin-top:.25rem;max-width:50rem}}
math{{font-size:1.08rem}}
math[display=block]{{margin:.3rem 0;padding:.3rem 0;text-align:left;overflow:auto hidden}}
pre{{background:var(--tint);padding:.6rem .8rem;overflow-x:auto;font-size:.82rem}}
@page{{size:A4;margin:14mm}}
@media print{{html{{font-size:9.5pt}}body{{font-size:1rem}}main{{max-width:none;padding:0}}
.verdict{{background:none;border-style:solid;border-width:1px 1px 1px .35rem}}
.scroll{{overflow:visible}}table{{font-size:.86em}}td,th{{padding-right:.5em}}.n{{white-space:normal}}h2{{break-after:avoid}}table,section>p{{break-inside:avoid}}}}
"""
