"""What parts of figures hand on: parameters, rows of tables, scenes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Params = Mapping[str, Any]  # parameters, or numbers, of a part
Row = dict[str, float | str | None]  # of a table
SceneDict = dict[str, Any]  # a scene, or a part of it, as `mitsuba.load_dict` takes it
