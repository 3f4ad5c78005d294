"""The scanned meshes: normals that every process reads with the same bits."""

from __future__ import annotations

import numpy as np
import pytest

mi = pytest.importorskip("mitsuba")
igl = pytest.importorskip("igl")

from figures.computing.scans import SCANS, prepare  # noqa: E402


@pytest.mark.parametrize("scan", SCANS)
def test_a_scan_has_its_normals_in_its_file_so_that_no_threads_sum_them_in_any_order(scan: str) -> None:
    prepare()
    file = SCANS[scan].file
    assert b"property float nx" in file.read_bytes()[:1000]
    read = [mi.traverse(mi.load_dict({"type": "ply", "filename": str(file)})) for _ in range(12)]
    normals = [np.array(mesh["vertex_normals"]).reshape(-1, 3) for mesh in read]
    # without normals in the file one load of the bunny in six differs
    assert all(np.array_equal(each, normals[0]) for each in normals)
    vertices, faces = (np.array(read[0][key]).reshape(-1, 3) for key in ("vertex_positions", "faces"))
    weighting = igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE
    expected = igl.per_vertex_normals(vertices.astype(float), faces.astype(np.int64), weighting)
    assert np.abs(normals[0] - expected).max() < 1e-5
