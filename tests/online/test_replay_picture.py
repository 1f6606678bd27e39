import numpy as np
import pytest
from pictures import MODES, is_white, share_of, texts

from adaptune.report.paper import LINES, OTHERS
from adaptune.space import Categorical, Float, ParameterSpace
from online.replay_picture import Track, draw_replays

SECONDS = np.arange(0.0, 20.0, 0.1)
REFERENCE = np.column_stack([SECONDS, np.sin(SECONDS)])


def track(**changed):
    made = Track(
        seconds=SECONDS,
        xy=REFERENCE,
        errors=np.where(SECONDS < 15.0, 0.7 + 0.1 * np.sin(SECONDS), np.nan),
        errors_behind=np.where(SECONDS > 5.0, 0.7 + 0.1 * np.sin(SECONDS - 5.0), np.nan),
        restarted=np.zeros(len(SECONDS), bool),
        choice_seconds=np.array([0.0, 8.0]),
        choices={"max_distance": [0.7, 0.9], "kernel": ["none", "huber"]},
        weights={},
        estimated=np.full((2, 3), np.nan),
        lost=np.zeros(2, bool),
    )
    return made._replace(**changed)


SPACE = ParameterSpace.of(
    odometry=Categorical(choices=("gicp", "ndt"), baseline="gicp"),
    max_distance=Float(low=0.1, high=2.0, baseline=1.0, log=True, unit="m_x"),
    kernel=Categorical(choices=("none", "huber"), baseline="none"),
)


def drawn(folder, tracks, reference=REFERENCE):
    path = folder / "three.png"
    draw_replays(path, "study: three", 15.0, tracks, reference, SPACE)
    return path, texts(path)


def test_all_modes_are_seen_where_they_are_equal(tmp_path):
    path, said = drawn(tmp_path, dict.fromkeys(MODES, track()))
    for mode in MODES:
        assert any(text.startswith(f"{mode}, mean RTE 0.") and text.endswith(" %") for text in said)
        assert share_of(path, LINES[mode]["color"], above=0.9) > 0.05, mode  # the legend is below
    for label in ("RTE over the next 15 m [%]", "time [s]", "x [m]", "y [m]", "reference", "start"):
        assert said.count(label) == 1, label
    for tick in ("0.7", "0.8", "none", "huber", "distance [m_x]"):
        assert tick in said
    assert is_white(path)


def test_what_is_not_there_has_no_caption(tmp_path):
    blind = track(errors=np.full(len(SECONDS), np.nan))
    said = drawn(tmp_path, dict.fromkeys(MODES, blind), None)[1]
    assert set(MODES) <= set(said)
    assert not [t for t in said if "RTE" in t or "restart" in t or "reference" in t or "bank" in t]
    assert "time [s]" in said


def test_restarts_are_marked_and_explained_once(tmp_path):
    restarted = np.zeros(len(SECONDS), bool)
    restarted[[50, 51, 52, 90]] = True
    lost = track(restarted=restarted)
    assert lost.restarts == [50, 90]  # three in a row are one mark
    tracks = dict.fromkeys(MODES, track()) | {"fixed": lost, "paper": lost}
    assert drawn(tmp_path, tracks)[1].count("restarted by the health check") == 1


def test_sets_of_several_odometries_leave_gaps(tmp_path):
    mixed = track(
        choices={
            "odometry": ["gicp", "ndt"],
            "max_distance": [0.9, np.nan],
            "kernel": ["huber", ""],
            "resolution": [np.nan, 2.0],
        }
    )
    other = track(
        choices={"odometry": ["gicp"] * 2, "max_distance": [0.7] * 2, "kernel": ["-"] * 2}
    )
    said = drawn(tmp_path, {"baseline": other, "fixed": other, "adaptive": mixed})[1]
    assert {"gicp", "ndt", "huber", "-", "odometry"} <= set(said)
    # Not all modes have one.
    assert "resolution" not in said
    assert "nan" not in said


def test_a_bank_has_its_weights_drawn_and_no_parameters(tmp_path):
    of_bank = track(
        choices={"max_distance": [77.0, 77.0], "kernel": ["alone", "alone"]},
        weights={"trial 4": [0.5, 0.2], "trial 17 (ndt)": [0.5, 0.8]},
    )
    path, said = drawn(tmp_path, {"baseline": track(), "fixed": track(), "adaptive": of_bank})
    assert {"weight [%]", "trial 4", "trial 17 (ndt)"} <= set(said)
    assert "adaptive applies a bank: weights of its members" in said
    assert share_of(path, OTHERS[0]) > 1.0
    assert share_of(path, OTHERS[1]) > 1.0
    assert not {"alone", "70", "77"} & set(said)  # of the heaviest member only


def measured(**changed):
    """A bank that measures its errors every second, and is lost twice."""
    seconds = np.arange(0.0, 20.0)
    error = np.where(seconds > 2.0, 0.7 + 0.1 * np.sin(seconds - 5.0), np.nan)
    lost = np.isin(seconds, [7.0, 8.0, 9.0, 19.0])
    share = 0.4 + 0.3 * np.sin(seconds)
    made = track(
        choice_seconds=seconds,
        choices={},
        weights={"trial 0": share, "trial 3": 1.0 - share},
        estimated=np.column_stack([error, 0.6 * error, np.where(lost, 40.0, 1.7) * error]),
        lost=lost,
    )
    return made._replace(**changed)


def test_estimated_and_true_error_are_drawn_over_each_other(tmp_path):
    bank = measured()
    assert bank.lost_spans == [(7.0, 10.0), (19.0, SECONDS[-1])]
    bare = track(choices={})
    path, said = drawn(tmp_path, {"baseline": bare, "untrained": bank})
    for label in (
        "untrained: its error as estimated while driving",
        "RTE over 15 m,",
        "last 30 s [%]",
        "estimated",
        "95 % interval",
        "true",
        "lost",
        "trial 3",
    ):
        assert said.count(label) == 1, label
    assert share_of(path, OTHERS[4]) > 0.02
    assert is_white(path)
    # Without a reference there is an estimate alone, and it is not lost.
    nothing = np.full(len(SECONDS), np.nan)
    blind = measured(errors=nothing, errors_behind=nothing, lost=np.zeros(20, bool))
    said = drawn(tmp_path, {"baseline": bare._replace(errors=nothing), "untrained": blind}, None)[1]
    assert "estimated" in said
    assert not {"true", "lost"} & set(said)
    assert not any("estimated" in text for text in drawn(tmp_path, {"baseline": bare})[1])


def test_names_and_numbers_share_an_axis(tmp_path):
    values = ([17.0, 17.0], ["auto", "auto"], ["True", "auto"])
    tracks = {
        mode: track(choices={"kernel": of_mode, "max_distance": [2.0, 2.0]})
        for mode, of_mode in zip(MODES, values, strict=False)
    }
    said = drawn(tmp_path, tracks)[1]
    assert [said.count(text) for text in ("auto", "17", "True")] == [1, 1, 1]
    assert "2" in said


def numbers(said):
    return [float(t.replace("\N{MINUS SIGN}", "-")) for t in said if t[-1].isdigit()]


@pytest.mark.parametrize("away", [1e3, 1e9])
def test_what_runs_away_does_not_shrink_the_rest(tmp_path, away):
    lost = track(xy=REFERENCE * [away, -away])
    path, said = drawn(tmp_path, {"baseline": lost, "fixed": track()})
    assert max(map(abs, numbers(said))) < 100.0
    assert share_of(path, LINES["fixed"]["color"]) > 0.3


def test_a_straight_path_is_no_sliver(tmp_path):
    straight = track(xy=np.column_stack([SECONDS, 1e-4 * SECONDS]))
    said = drawn(tmp_path, {"baseline": straight, "fixed": straight}, straight.xy)[1]
    assert min(numbers(said)) < -2.0


def test_an_odometry_without_parameters_or_reference_is_drawn(tmp_path):
    bare = track(choices={}, errors=np.full(len(SECONDS), np.nan))
    assert "from above" in drawn(tmp_path, {"baseline": bare, "fixed": bare}, None)[1]
