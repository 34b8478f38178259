"""Table I of the paper, as `python -m benchmarks stability` prints it."""

import pytest

from benchmarks.stability import PRINTED, Row, table_rows


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return table_rows()


@pytest.mark.parametrize("form", PRINTED)
@pytest.mark.parametrize("weights", ["lumped", "full process"])
def test_float64_without_radii_has_the_papers_ticks(rows: list[Row], form: str, weights: str) -> None:
    kind = ("no radii", weights, form, "float64")
    (row,) = [row for row in rows if (row.cloud, row.weights, row.form, row.number) == kind]
    assert tuple(cell.num_bad == 0 for cell in row.cells) == PRINTED[form]


def test_the_log_domain_is_finite_and_right_with_and_without_radii(rows: list[Row]) -> None:
    ours = [row for row in rows if row.form in {"log domain", "GpdfField"}]
    assert {row.cloud for row in ours} == {"no radii", "1 mm to 30 cm"}
    for row in ours:
        for cell in row.cells:
            assert cell.num_bad == 0
            assert cell.error is not None
            assert cell.error < 1e-6, (row, cell)


def test_shifting_by_the_nearest_centre_overflows_with_radii(rows: list[Row]) -> None:
    with_radii = [row for row in rows if row.cloud != "no radii" and row.form == "eq. 12"]
    assert len(with_radii) == 2
    for row in with_radii:
        assert [cell.num_bad > 0 for cell in row.cells] == [False, False, True, True, True, True]
