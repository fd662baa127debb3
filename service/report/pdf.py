"""The report as a PDF, from the same blocks as the page."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from service.report.blocks import Appendix, Block, Facts, Figures, Heading, Table, Text, Title
from service.report.plots import small_picture

if TYPE_CHECKING:
    from fpdf import FPDF

INK, SOFT, OK, BAD = (28, 39, 51), (86, 100, 111), (31, 122, 77), (179, 38, 30)
LINE = (217, 224, 231)
MARGIN_MM, GAP_MM = 14.0, 3.0
BODY_PT, SMALL_PT = 8.5, 7.5
ROW_MM = 4.2
CROP_MM = 7.5
LEAST_WIDTH, MOST_WIDTH = 11, 40  # of a column, in characters


def pdf_of(blocks: Iterable[Block], folder: Path) -> bytes:
    """Return the blocks as a PDF on A4; `folder` has the pictures."""
    paper = _paper()
    for block in blocks:
        _add(paper, block, folder)
    return bytes(paper.output())


def _paper() -> FPDF:
    import matplotlib
    from fpdf import FPDF

    class Paper(FPDF):
        def footer(self) -> None:
            self.set_y(-10)
            self.set_font(size=SMALL_PT)
            self.set_text_color(*SOFT)
            self.cell(0, 4, f"{self.title or ''} · page {self.page_no()} of {{nb}}", align="C")

    paper = Paper(format="A4")
    fonts = Path(matplotlib.get_data_path()) / "fonts/ttf"  # a font with the letters of most languages
    paper.add_font("body", "", fonts / "DejaVuSans.ttf")
    paper.add_font("body", "B", fonts / "DejaVuSans-Bold.ttf")
    paper.set_margin(MARGIN_MM)
    paper.set_auto_page_break(True, MARGIN_MM)
    paper.set_font("body", size=BODY_PT)
    paper.add_page()
    return paper


def _add(paper: FPDF, block: Block, folder: Path) -> None:
    match block:
        case Title():
            paper.set_title(block.text)
            _line(paper, block.text, size_pt=15.0, style="B")
            _line(paper, block.below, colour=SOFT)
        case Heading():
            paper.ln(2.5)
            if paper.will_page_break(14.0):
                paper.add_page()
            _line(paper, block.text, size_pt=10.5, style="B")
        case Appendix():
            paper.add_page()
            _line(paper, block.text, size_pt=15.0, style="B")
        case Text():
            colour = BAD if "bad" in block.look else OK if "ok" in block.look else SOFT if "soft" in block.look else INK
            is_verdict = "verdict" in block.look
            _line(
                paper,
                block.text,
                size_pt=12.0 if is_verdict else BODY_PT,
                style="B" if is_verdict else "",
                colour=colour,
            )
        case Facts():
            _facts(paper, block)
        case Table():
            _table(paper, block, folder)
        case Figures():
            _figures(paper, block, folder)


def _line(
    paper: FPDF, text: str, *, size_pt: float = BODY_PT, style: str = "", colour: tuple[int, int, int] = INK
) -> None:
    paper.set_font("body", style, size_pt)
    paper.set_text_color(*colour)
    paper.multi_cell(0, 0.5 * size_pt, text, align="L", new_x="LMARGIN", new_y="NEXT")
    paper.set_font("body", "", BODY_PT)
    paper.set_text_color(*INK)


def _facts(paper: FPDF, block: Facts) -> None:
    paper.ln(1.5)
    top, width = paper.get_y(), paper.epw / len(block.items)
    for k, (value, what) in enumerate(block.items):
        for text, size_pt, colour, down in ((value, 10.0, INK, 0.0), (what, SMALL_PT, SOFT, 5.0)):
            paper.set_xy(MARGIN_MM + k * width, top + down)
            paper.set_font("body", "B" if down == 0.0 else "", size_pt)
            paper.set_text_color(*colour)
            paper.cell(width, 4.5, text[:24])
    paper.set_xy(MARGIN_MM, top + 10.0)
    paper.set_font("body", "", BODY_PT)
    paper.set_text_color(*INK)


def _table(paper: FPDF, block: Table, folder: Path) -> None:
    from fpdf.enums import TableBordersLayout
    from fpdf.fonts import FontFace

    looks = {"ok": FontFace(color=OK), "bad": FontFace(color=BAD), "soft": FontFace(color=SOFT)}
    paper.set_font("body", "", SMALL_PT)
    paper.set_draw_color(*LINE)
    has_pictures = any(cell.picture for row in block.rows for cell in row)
    with paper.table(
        col_widths=_widths(block),
        text_align=tuple("RIGHT" if k in block.numbers else "LEFT" for k in range(len(block.columns))),
        borders_layout=TableBordersLayout.HORIZONTAL_LINES,
        headings_style=FontFace(emphasis="", color=SOFT),
        line_height=ROW_MM,
        padding=(0.4, 1.2),
        v_align="MIDDLE",
    ) as table:
        table.row(block.columns)
        for cells in block.rows:
            row = table.row(min_height=CROP_MM if has_pictures else None)
            for cell in cells:
                if cell.picture is not None:
                    row.cell(img=io.BytesIO(small_picture(folder / cell.picture)))
                else:
                    row.cell(cell.text, style=looks.get(cell.look))
    paper.set_font("body", "", BODY_PT)
    paper.ln(1.0)


def _widths(block: Table) -> tuple[int, ...]:
    """Return the shares of the columns, by their longest text."""
    return tuple(
        min(MOST_WIDTH, max(LEAST_WIDTH, len(name), *(len(row[k].text) for row in block.rows)))
        for k, name in enumerate(block.columns)
    )


def _figures(paper: FPDF, block: Figures, folder: Path) -> None:
    from PIL import Image

    width = (paper.epw - GAP_MM * (block.across - 1)) / block.across
    for first in range(0, len(block.items), block.across):
        row = [
            (caption, data, width * size[1] / size[0])
            for name, caption in block.items[first : first + block.across]
            for data in [small_picture(folder / name)]
            for size in [Image.open(io.BytesIO(data)).size]
        ]
        below = 10.0
        if paper.will_page_break(max(height for _, _, height in row) + below):
            paper.add_page()
        top, bottom = paper.get_y(), 0.0
        for k, (caption, data, height) in enumerate(row):
            left = MARGIN_MM + k * (width + GAP_MM)
            paper.image(io.BytesIO(data), x=left, y=top, w=width)
            paper.set_xy(left, top + height + 0.8)
            paper.set_font("body", "", SMALL_PT)
            paper.set_text_color(*SOFT)
            paper.multi_cell(width, 3.2, caption, align="L")
            bottom = max(bottom, paper.get_y())
        paper.set_xy(MARGIN_MM, bottom + 2.0)
        paper.set_font("body", "", BODY_PT)
        paper.set_text_color(*INK)
