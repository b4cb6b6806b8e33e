"""A page shows what it is given, as text, and needs nothing outside of it."""

import base64
import io
import os
import re

import numpy as np
import pytest
from html_reader import Page, leaves, read
from PIL import Image

from cref_jax.errors import ConfigError
from cref_jax.pages import markup
from cref_jax.pages.markup import Column, Section

EVIL = """<script>alert("1")</script>&amp;'"><img src=x onerror=alert(1)>"""


def line(axis):
    axis.plot([0.0, 1.0, 2.0], [0.123456789, 1.0, 4.0])


def whole(*parts):
    return markup.document("a title", markup.Html(), [Section("a part", markup.join(*parts))])


def test_text_never_becomes_markup_wherever_it_stands():
    parts = {
        "paragraph": markup.paragraph(EVIL),
        "code": markup.code(EVIL),
        "note": markup.note("see ", EVIL),
        "tile": markup.tiles([(EVIL, EVIL)]),
        "pair": markup.definition_list([(EVIL, EVIL)]),
        "table": markup.table([Column(EVIL), Column(EVIL, True)], [(EVIL, EVIL)], EVIL),
        "collapsible": markup.collapsible(EVIL, EVIL),
        "attribute": markup.element("p", "x", title=EVIL),
        "subsections": markup.subsections([Section(EVIL, markup.paragraph("x"))]),
    }
    for name, part in parts.items():
        seen = Page(whole(part))
        assert not {"script", "img"} & set(seen.tags), name
        assert EVIL in seen.text or name == "attribute"
    seen = Page(markup.document(EVIL, markup.escape(EVIL), [Section(EVIL, markup.Html())], EVIL))
    assert seen.text.count(EVIL) == 6  # title, heading, lead, link, section, foot
    assert not {"script", "img"} & set(seen.tags)


def test_what_a_chart_or_a_file_is_called_never_becomes_markup(tmp_path):
    path = tmp_path / "<b>'\"&.png"
    Image.new("RGB", (2, 2)).save(path)
    seen = Page(whole(markup.chart(line, EVIL, EVIL), markup.media(path)))
    assert seen.tags.count("img") == 2 and not {"script", "b"} & set(seen.tags)
    assert EVIL in seen.text and path.name in seen.text


def test_a_file_name_that_is_no_unicode_can_be_shown(tmp_path):
    markup.write(tmp_path / "a.html", whole(markup.code(os.fsdecode(b"run-\xff"))))
    assert "run-?" in read(tmp_path / "a.html").text


def test_no_reference_leaves_the_page_and_a_browser_is_told_so():
    text = whole(markup.chart(line, "a line"), markup.paragraph("x"))
    seen = Page(text)
    assert leaves(seen) == [] and seen.alone == []
    assert not re.search(r"https?://", text)
    assert "default-src 'none'" in text and text.startswith("<!doctype html>\n<html lang=")


def svg(drawn):
    return base64.b64decode(re.search(r"base64,([^\"]+)", drawn)[1]).decode()


def test_equal_charts_are_equal_bytes_and_their_letters_need_no_font():
    assert markup.chart(line, "x") == markup.chart(line, "x")
    assert "<text" not in svg(markup.chart(line, "x"))


def test_rounding_keeps_every_point_and_the_scale_of_letters():
    # three points, with at most two digits behind the point; letters are scaled by 1/64
    drawn = svg(markup.chart(line, "x"))
    curve = next(d for d in re.findall(r'd="([^"]+)"', drawn) if d.count("L ") == 2)
    assert not re.search(r"\.\d{3}", curve)
    assert "scale(0.015625)" in drawn


def test_a_small_picture_is_in_the_page_bit_for_bit(tmp_path):
    path = tmp_path / "a.png"
    Image.effect_noise((64, 48), 50.0).save(path)
    inside = re.search(r"data:image/png;base64,([^\"]+)", markup.media(path))[1]
    assert base64.b64decode(inside) == path.read_bytes()


def test_a_large_picture_is_compressed_and_looks_the_same(tmp_path):
    slope = Image.linear_gradient("L").resize((900, 900))
    picture = Image.merge("RGB", (slope, slope.rotate(90), slope.rotate(180)))
    picture.save(tmp_path / "a.png", compress_level=0)
    before = (tmp_path / "a.png").stat().st_size
    assert before > markup.LARGE_PICTURE
    inside = re.search(r"data:image/webp;base64,([^\"]+)", markup.media(tmp_path / "a.png"))[1]
    content = base64.b64decode(inside)
    assert len(content) < 0.1 * before
    shown = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), float)
    assert np.abs(shown - np.asarray(picture)).mean() < 3.0  # of 255


def test_a_large_picture_that_is_cut_off_is_shown_as_it_is(tmp_path):
    Image.effect_noise((900, 900), 50.0).save(tmp_path / "a.png")
    cut = (tmp_path / "a.png").read_bytes()[:400_000]
    (tmp_path / "a.png").write_bytes(cut)
    inside = re.search(r"data:image/png;base64,([^\"]+)", markup.media(tmp_path / "a.png"))[1]
    assert base64.b64decode(inside) == cut


def test_a_film_is_in_the_page_or_named_where_it_is_too_large(tmp_path):
    path = tmp_path / "play.mp4"
    path.write_bytes(b"\0\0\0\x20ftypisom" + bytes(5_000_000))
    assert "<video" in markup.media(path)
    note = markup.media(path, most=4_000_000)
    assert "<video" not in note and "play.mp4" in note and "(5.0 MB) is left out" in note


@pytest.mark.parametrize("name", ["a.png", "a.mp4"])
def test_a_file_that_is_not_what_its_name_says_is_a_note(tmp_path, name):
    (tmp_path / name).write_bytes(b"<svg onload=alert(1)>")
    assert f"is not a valid {name[2:]} file" in Page(markup.media(tmp_path / name)).text
    assert "cannot be read" in markup.media(tmp_path / f"b{name[1:]}")


def test_a_row_with_a_cell_too_few_is_refused():
    with pytest.raises(ValueError):
        markup.table([Column("a"), Column("b")], [("1",)])


def test_a_page_that_cannot_be_written_is_one_line_and_leaves_nothing(tmp_path):
    with pytest.raises(ConfigError, match=r"must end in \.html: .*a\.pdf"):
        markup.write(tmp_path / "a.pdf", "x")
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="cannot write"):
        markup.write(tmp_path / "file" / "a.html", "x")
    (tmp_path / "b.html").mkdir()
    with pytest.raises(ConfigError, match="cannot write"):
        markup.write(tmp_path / "b.html", "x")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.html", "file"]
