import numpy as np
import pytest
from rooms import straight, trajectory
from tables import with_run

from adaptune.metrics import KittiError, kitti_error
from adaptune.reference.judge import Reference, StandardErrors
from adaptune.trajectory import read_kitti
from online.compare import pooled
from online.statistics import ComparisonRow, JudgedModes


def over_all(rows):
    """The row of the only mode over all sequences."""
    return pooled([JudgedModes(r.sequence, [r], {r.mode: np.ones(30)}, 3) for r in rows])[0]


def row(sequence, standard, mode="fixed"):
    return ComparisonRow(sequence, mode, 1.0, 1.0, standard=standard)


def test_errors_of_a_recorded_pair_are_those_of_evo_and_kitti(recorded):
    folder = recorded / "kitti_00"
    truth = trajectory(read_kitti(folder / "ground_truth_kitti.txt"))
    found = Reference(truth, 100.0).standard(trajectory(read_kitti(folder / "kiss_icp_kitti.txt")))
    assert found.ape == pytest.approx(3.500719, abs=1e-6)
    assert found.rpe == pytest.approx(0.034188, abs=1e-6)
    assert found.kitti.translation == pytest.approx(0.5283, abs=5e-5)
    cells = row("00", found).standard_columns()
    assert cells["APE [m]"] == found.ape
    assert cells["[deg/100 m]"] == pytest.approx(0.1887, abs=1e-4)
    assert cells["over [m]"] == "100-800"
    files = row("00", found).columns()
    assert files["kitti_lengths_m"] == "100 200 300 400 500 600 700 800"
    assert files["kitti_deg_per_m"] == found.kitti.rotation


@pytest.mark.parametrize(("metres", "lengths"), [(99, None), (150, "100"), (250, "100-200")])
def test_kittis_error_is_there_from_100_m_on(metres, lengths):
    truth = straight(metres + 2)
    found = Reference(trajectory(truth), 25.0).standard(trajectory(straight(metres + 2, 1.01)))
    cells = row("a", found).standard_columns()
    assert cells["over [m]"] == lengths
    assert (cells["KITTI [%]"] is None) == (lengths is None)
    assert cells["APE [m]"] > 0.1
    assert cells["RPE [m]"] == pytest.approx(0.01)


def test_all_sequences_have_mean_errors_and_kittis_over_all_sub_trajectories():
    truth = straight(400)
    truth[:, 1, 3] = np.sin(0.05 * np.arange(400))
    estimate = truth.copy()
    estimate[:, 1, 3] *= 1.1
    parts = [kitti_error(truth, estimate, (length,)) for length in (100.0, 200.0, 300.0)]
    want = kitti_error(truth, estimate)
    assert len({part.n for part in parts}) == 3  # the mean of the means is another
    short = KittiError(np.nan, np.nan, ())
    rows = [row(f"s{i}", StandardErrors(1.0 + i, 0.1, k)) for i, k in enumerate([*parts, short])]
    found = over_all([*rows, row("blind", None)])
    assert found.standard.ape == pytest.approx(2.5)
    assert found.standard.rpe == pytest.approx(0.1)
    assert found.standard.kitti[:2] == pytest.approx(want[:2])
    assert found.standard.kitti[2:] == want[2:]
    assert over_all([row("a", None)]).standard is None
    assert np.isnan(over_all([row("a", StandardErrors(1.0, 0.1, short))]).standard.kitti[0])


def test_what_a_mode_costs_is_in_its_columns():
    cells = with_run(row("a", None), cpu_ms=12.5, memory_mb=300.0).columns()
    assert (cells["cost [ms]"], cells["memory [MB]"]) == (12.5, 300.0)
    old = row("a", None).columns()
    assert old["cost [ms]"] is old["memory [MB]"] is None
    costs = {"a": (10.0, 200.0), "b": (20.0, 400.0)}
    rows = [with_run(row(name, None), cpu_ms=ms, memory_mb=mb) for name, (ms, mb) in costs.items()]
    of_all = over_all(rows)
    assert of_all.run.cpu_ms == pytest.approx(15.0)
    assert of_all.run.memory_mb == 400.0
    assert over_all([row("a", None), row("b", None)]).run.cpu_ms is None
