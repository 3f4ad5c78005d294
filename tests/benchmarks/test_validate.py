"""The table of truths and the command that holds the tracer against it."""

from __future__ import annotations

import csv
import json
import math

import pytest
from typer.testing import CliRunner

from benchmarks.__main__ import app
from benchmarks.truths import Comparison, read_truths, trace_order, validate
from benchmarks.truths_commands import row_filter, summary
from halfspace_sss import Medium, trace
from halfspace_sss.physics import single_scattering

HEADER = "id,kind,quantity,geometry,albedo,g,eta,mu_i,mu_o,phi_deg,other,value,uncertainty,source,note\n"
ONE_OF_EACH = "T0263,T0268,T0134,T0139,T0285,T0286,T0704,T0800,T0801,T0816,T0825"


def table(folder, line: str):
    path = folder / "table.csv"
    path.write_text("# a comment\n" + HEADER + line + "\n")
    return path


def command(*arguments: str):
    return CliRunner().invoke(app, ["validate", *arguments])


def test_every_row_is_covered_or_has_a_reason(truths):
    covered, others = read_truths()
    assert sorted(t.id for t in (*covered, *others)) == sorted(row["id"] for row in truths)
    assert len(covered) == 671 and all(other.reason for other in others)


def test_rows_not_covered_are_models_slabs_layers_and_slides():
    words = ("published model", "slab", "layers", "glass slide")
    assert all(any(word in other.reason for word in words) for other in read_truths()[1])


def test_relative_uncertainties_are_relative_to_the_value():
    rows = {t.id: t for t in read_truths()[0]}
    assert rows["T0015"].uncertainty == pytest.approx(0.02 * 2890.7)
    assert rows["T0118"].uncertainty == 3e-4
    assert rows["T0800"].uncertainty == pytest.approx(1e-8 * 1.975422127)


def test_coefficients_and_rings_in_centimetres_become_millimetres():
    row = next(t for t in read_truths()[0] if t.id == "T0016")
    assert row.medium == Medium(9.0, 1.0, 0.0, 1.5) and row.ring == (0.02, 0.04) and row.factor == 100


def test_azimuths_in_degrees_become_radians():
    row = next(t for t in read_truths()[0] if t.id == "T0704")
    assert row.direction == pytest.approx((0.5, math.pi))


def test_the_first_order_traced_alone_is_the_exact_single_order():
    medium = Medium.from_albedo(0.7, 2.0, 0.4, 1.3)
    for mu_i in (0.6, "diffuse"):
        estimate, n_paths, n_events = trace_order(medium, mu_i, 1, 200_000, 3)
        assert n_events > n_paths >= 200_000
        assert abs(estimate.value - single_scattering.reflectance(medium, mu_i)) < 4 * estimate.standard_error


def test_orders_add_up_to_the_whole_reflectance():
    medium = Medium.from_albedo(0.2, 1.0, 0.0, 1.0)
    orders = [trace_order(medium, 1.0, k, 200_000, 4)[0] for k in range(1, 7)]
    error = math.sqrt(sum(e.standard_error**2 for e in orders))
    whole = trace(medium, 1.0, 200_000, 5).reflectance()
    difference = sum(e.value for e in orders) - whole.value
    assert abs(difference) < 4 * math.hypot(error, whole.standard_error) + 0.2**7  # what the orders above six hold


def test_z_counts_both_errors():
    truth = next(t for t in read_truths()[0] if t.id == "T0118")
    c = Comparison(truth, truth.value + 1e-3, 4e-4, 1, 1, 0)
    assert c.z == pytest.approx(1e-3 / 5e-4)


def test_z_of_a_value_that_is_not_a_number_is_a_failure():
    truth = read_truths()[0][0]
    assert Comparison(truth, math.nan, 0.1, 1, 1, 0).z == math.inf


def test_one_row_of_each_quantity_passes_and_is_the_same_in_any_company():
    few = validate(row_filter(ONE_OF_EACH), quick=True)
    assert not few.failures
    alone = validate(row_filter("T0268"), quick=True).comparisons[0]
    assert alone == next(c for c in few.comparisons if c.truth.id == "T0268")


def test_asked_for_errors_are_reached():
    rows = validate(row_filter("T0286,T0704"), quick=False, seed=1).comparisons
    limits = {"R_total": 1e-3, "BRDF": 2e-3}
    assert all(c.standard_error <= limits[c.truth.measure] * c.reflected for c in rows) and len(rows) == 2


def test_the_summary_has_rows_errors_and_z_of_each_quantity():
    rows = summary(validate(row_filter("single"), quick=True).comparisons)
    assert sum(s["rows"] for s in rows) == 24 and all(s["rms_z"] <= s["max_abs_z"] < 4 for s in rows)


def test_the_command_writes_rows_and_provenance_and_exits_with_zero(tmp_path):
    result = command("--quick", "--rows", "T0286,T0825", "--seed", "2", "--out", str(tmp_path))
    assert result.exit_code == 0, result.output
    rows = list(csv.DictReader((tmp_path / "validate.csv").open()))
    content = json.loads((tmp_path / "validate.json").read_text())
    assert [r["id"] for r in rows] == ["T0286", "T0825"] and abs(float(rows[0]["z"])) < 4
    assert content["provenance"]["parameters"]["seed"] == 2 and len(content["not_covered"]) == 56
    assert all(float(r["standard_error"]) > 0 for r in rows)


def test_the_command_exits_with_one_and_names_the_row_that_fails(tmp_path, monkeypatch):
    wrong = table(tmp_path, "T9,exact,R_d,half-space,0.5,0,1,1,,,,0.2,1e-8,,")
    monkeypatch.setattr("benchmarks.truths.TABLE", wrong)
    result = command("--quick")
    assert result.exit_code == 1 and "T9" in result.output


def test_the_command_refuses_rows_that_do_not_exist():
    result = command("--rows", "T0001")
    assert result.exit_code == 2 and "at least one row" in result.output
    assert command("--rows", "bogus").exit_code == 2


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed must be a whole number >= 0, got -1"):
        validate(seed=-1)
