"""Tables in the documentation that state what the validation asserts."""

import pytest
from docs_tables import DOCS, tables, with_tables


@pytest.mark.parametrize("page", tables())
def test_tables_of_a_page_are_current(page):
    """Otherwise: `make validate`, which writes them."""
    text = (DOCS / page).read_text(encoding="utf-8")
    assert with_tables(text, tables()[page]) == text


def test_table_is_replaced_between_its_markers():
    page = "before\n<!-- table: x -->\nold\n<!-- end of table -->\nafter\n"
    new = with_tables(page, {"x": "| a |"})
    assert new == "before\n<!-- table: x -->\n\n| a |\n\n<!-- end of table -->\nafter\n"
    assert with_tables(new, {"x": "| a |"}) == new
    with pytest.raises(ValueError, match="has 0 places for the table 'y'"):
        with_tables(page, {"y": "| a |"})
