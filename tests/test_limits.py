"""docs/limits.md tells what models take as their capabilities do."""

from __future__ import annotations

from dataclasses import fields, replace

import limits_table

from full_geometry.settings import Capabilities


def test_the_table_of_the_page_is_that_of_the_capabilities() -> None:
    page = limits_table.PAGE.read_text(encoding="utf-8")
    assert page == limits_table.replaced(page), "python -m tests.limits_table writes it"


def test_every_capability_has_a_row_but_for_what_a_model_is_of() -> None:
    none, told = Capabilities(), set()
    for field in fields(Capabilities):
        other = replace(none, **{field.name: not none.straight if field.type == "bool" else "total"})
        try:
            rows = [row for row, tell in limits_table.ROWS.items() if tell(other) != tell(none)]
        except KeyError:
            rows = ["varying"]
        told |= {field.name} if rows else set()
    assert {field.name for field in fields(Capabilities)} - told == {"of_half_space"}
