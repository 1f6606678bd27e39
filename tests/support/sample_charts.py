"""A page and charts with every kind of item, for tests."""

import numpy as np

from adaptune.report.charts import Axis, Band, Chart, Line, Panel, Points, Spans, shares
from adaptune.report.page import Page, PageSection
from adaptune.report.tables import Listing

TIME = Axis("time [s]")
RTE = Axis("RTE over the next 20 m [%]", log=True)


def over_time() -> Chart:
    """Lines of modes, bands, spans, shares and marks below each other, with a gap."""
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 240.0, 6000)
    error = np.exp(np.cumsum(rng.normal(size=len(t))) / 40.0)
    scenes = Spans((0, 40, 90, 100, 180, 240), ("room", "corridor", "", "open square", "room"))
    lines = (
        scenes,
        Line(t, error, "fixed"),
        Line(t, np.where((t > 60.0) & (t < 70.0), np.nan, 0.8 * error), "adaptive"),
    )
    k = np.arange(0.0, 241.0, 20.0)
    estimate = (
        Band(k, 0.5 + 0 * k, 1.5 + np.sin(k / 30.0), "95 % interval"),
        Line(t, error, "fixed", faint=True),
    )
    weights = rng.dirichlet(np.ones(3), len(k)).T
    members = shares(k, weights, ("trial 3", "trial 17", "trial 242"))
    return Chart(
        "over-time",
        "Errors and selections over time",
        (
            Panel(TIME, RTE, lines, "error of the replays", height=1.6),
            Panel(TIME, Axis("RTE, last 30 s [%]"), estimate, "its error as estimated"),
            Panel(
                TIME, Axis("weight [-]", limits=(0.0, 1.0)), tuple(members), "members of the bank"
            ),
        ),
        "The adaptive mode lost its reference for ten seconds.",
        shared_x=True,
    )


def trials(n: int = 2000) -> Chart:
    """Scatters of trials, with colours, and one with names."""
    rng = np.random.default_rng(1)
    cost, error = rng.lognormal(2.0, 0.5, n), rng.lognormal(0.0, 0.7, n)
    size = rng.lognormal(-1.0, 1.0, n)
    texts = [f"trial {i}: voxel_size {size[i]:.3g}" for i in range(n)]
    points = Points(cost, error, "trials", size, "voxel size [m]", texts=texts)
    kinds = Axis("registration", names=("point to point", "point to plane", "GICP"))
    named = Points(np.arange(60) % 3, error[:60], "trials")
    return Chart(
        "trials",
        "Trials: error over cost, and over the kind of registration",
        (
            Panel(Axis("time for a scan [ms]", log=True), RTE, (points,), "all trials"),
            Panel(kinds, RTE, (named, Points([0, 1, 2], [0.8, 0.4, 0.3], "fixed"))),
        ),
        columns=2,
    )


def comparison() -> Chart:
    names = ("campus, morning", "campus, evening", "tunnel <b>north</b>", "forest_$x_1$")
    points = Points(np.arange(4.0), [1.0, 2.0, 0.7, np.nan], "kiss & tell")
    return Chart(
        "comparison",
        "Errors by sequence",
        (
            Panel(Axis("sequence", names=names), Axis("mean RTE [%]"), (points,)),
            Panel(
                Axis("error over the fixed set's [-]"),
                Axis("parameter", names=("voxel_size", "max_range", "iterations")),
                (Line([0.0, 1.4, np.nan, 0.0, 0.8], [0, 0, 0, 1, 1], "fixed", width=20.0),),
            ),
        ),
        columns=2,
    )


def from_above() -> Chart:
    a = np.linspace(0.0, 2.0 * np.pi, 5000)
    x, y = 40.0 * np.cos(a), 15.0 * np.sin(2.0 * a)
    drawn = (
        Line(x + 1.0, y - 1.0, "fixed"),
        Points(x[::200], y[::200], "reference", shape="circle"),
        Points([40.0], [0.0], "start", shape="cross"),
    )
    panel = Panel(Axis("x [m]"), Axis("y [m]"), drawn, equal=True)
    return Chart("from-above", "Trajectories from above", (panel,))


def empty() -> Chart:
    drawn = (
        Line([], [], "fixed"),
        Points([1.0], [np.nan], "trials", [np.nan], "size [m]"),
        Band([], [], [], "band"),
        *shares([], np.zeros((2, 0)), ("a", "b")),
    )
    panel = Panel(Axis("x [-]", log=True), Axis("y [-]", log=True), drawn)
    return Chart("empty", "Nothing was measured", (panel,))


def samples() -> tuple[Chart, ...]:
    return over_time(), trials(), comparison(), from_above(), empty()


def sample_page() -> Page:
    """A page of all samples, with tables, one of them wide, and names that look like HTML."""
    rows = [
        {
            "sequence": f"drive_{i}" + "_with_a_long_name" * (i == 3),
            "mode": ("fixed", "adaptive", "<script>alert(1)</script>")[i % 3],
            "mean_RTE": (2.5, 10.25, None, 0.0042, float("nan"), 9.0)[i % 6],
            "scans": 1000 - 7 * i,
            **{f"parameter_{k}": 0.1 * k for k in range(6)},
            "remark": "It lost its way in the tunnel, and found it again at the far end."
            * (i == 1),
            "_file": "only",
        }
        for i in range(12)
    ]
    return Page(
        "Adaptive tuning of KISS-ICP & friends </title><script>alert(2)</script>",
        "study tunnel.yaml, 12 drives, 2000 trials",
        ("The adaptive mode has the smallest error: 0.42 %, where the fixed set has 0.61 %.",),
        (
            PageSection(
                "Results",
                charts=(comparison(), over_time()),
                tables=(Listing("Errors by drive", rows, "Only drives with a reference."),),
            ),
            PageSection("Trials", charts=(trials(), from_above())),
            PageSection(
                "What is missing",
                notes=("drive_7 has no reference.",),
                charts=(empty(),),
                tables=(Listing("Costs", []),),
            ),
        ),
    )
