"""Tune an odometry on recordings, in one call: decide a study, train, replay and compare."""

import base64
import logging
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Any

from adaptune._system.files import plain_name
from adaptune._system.progress import Progress, bars_and_words
from adaptune.errors import AdaptuneError
from adaptune.odometry import Odometry
from adaptune.odometry.registry import forget_user_code
from adaptune.recording.fleet import Reading
from adaptune.report.page import FIGURES
from adaptune.space import ParameterSet
from adaptune.tuning.asked import Asked, check_guarded, named_odometry
from adaptune.tuning.page import write_study_page
from adaptune.tuning.studies import write_study
from adaptune.tuning.verdict import write_verdict
from offline.campaign import FITTING
from offline.config import OfflineStudy
from offline.scenario import scenario
from offline.search import ELAPSED, Stopwatch
from offline.train import Training, run_odometries, train
from online.compare import Comparison, compare
from online.modes import BASELINE, FIXED, replay_modes, run_replays
from online.statistics import ALL

_log = logging.getLogger(__name__)
Paths = str | Path | Sequence[str | Path]
One = str | type[Odometry] | Odometry


@dataclass(frozen=True, eq=False, repr=False)
class Tuned:
    """What tuning has found.

    Tables are data frames if pandas is installed; else they are lists of rows, and `errors` is a
    dict of columns.
    """

    study: OfflineStudy
    training: Training
    comparison: Comparison
    page: Path  # HTML, with all charts and tables
    more: Sequence[str] = ()  # recordings that the study did not name before
    before: ParameterSet | None = None  # the fixed set before, where there was one
    of_each: Sequence[Mapping[str, Any]] = ()  # see `odometries`

    @property
    def verdict(self) -> str:
        """What to drive, and why."""
        return " ".join(self.comparison.verdict)

    @property
    def fixed(self) -> ParameterSet:
        """The fixed set; the verdict says whether to drive it."""
        sets = self.training.model.sets
        return sets[self.training.model.fixed]

    @property
    def front(self) -> Any:
        """What CPU time buys: a row for each choice, with its error and its cost.

        Those of the test are from there, the others of whole drives in training; the errors of
        `trials` are of segments.
        """
        return _table(self.comparison.front)

    @property
    def trials(self) -> Any:
        """A row for each parameter set that was tried."""
        return _table(self.training.trials)

    @property
    def errors(self) -> Any:
        """Errors by frame in training, a column for each set, with time, place and descriptors.

        The `attrs` of the data frame have each column's parameters.
        """
        found = scenario(self.study)
        table = _table(found.columns())
        if hasattr(table, "attrs"):
            table.attrs |= {f"rte_{trial}": found.sets[trial] for trial in found.sets}
        return table

    @property
    def modes(self) -> Any:
        """A row for each mode on each recording of the test, and on all of them."""
        return _table([row.columns() for row in self.comparison.rows])

    @property
    def odometries(self) -> Any:
        """Of several odometries, two rows for each: its own parameters, and its best set."""
        return _table(self.of_each)

    @property
    def left_out(self) -> Any:
        """A row for each recording: what the baseline has there, and what the others recommend."""
        return _table(left_out_rows(self.training, self.comparison))

    @property
    def files(self) -> dict[str, Path]:
        """The study, the fixed set (again as the odometry's own tool reads it), model, tables."""
        own = self.study.own_file(self.fixed)
        folder = self.study.folder
        named = {"study": folder / f"{folder.resolve().name}.yaml", "page": self.page}
        named |= {"fixed": folder / "fixed.yaml", "model": self.study.model_path}
        named |= {"verdict": folder / "verdict.json"}
        named |= {"own": own[0]} if own else {}
        tables = ("trials", "front", "training", "comparison/comparison")
        named |= {Path(key).name: folder / f"{key}.csv" for key in tables}
        return {key: path for key, path in named.items() if path.exists()}

    def __repr__(self) -> str:
        return f"<Tuned: {self.comparison.verdict[0]} More: {self.page}>"

    def _repr_html_(self) -> str:
        """Its verdict, the picture of the drive on the page, and the front."""
        shown, picture = "", self.page.parent / FIGURES / "overview.png"
        if picture.exists():
            source = f"data:image/png;base64,{base64.b64encode(picture.read_bytes()).decode()}"
            shown = f'<img style="max-width: 100%" src="{source}">'
        table = getattr(self.front, "_repr_html_", str)()
        return f"<p>{escape(self.verdict)}</p>{shown}{table}"


def left_out_rows(training: Training, comparison: Comparison) -> list[dict[str, Any]]:
    """Errors of the baseline and of what the other recordings recommend on each, the worst first.

    For the test, that is the fixed set.
    """
    rows = comparison.rows
    rte = {(row.sequence, row.mode): row.rte for row in rows if row.sequence != ALL}
    known = [
        (row["sequence"], row["baseline, whole"], row["_left out"], "training")
        for row in training.rows
    ]
    known += [(n, rte[n, BASELINE], rte.get((n, FIXED)), "test") for n, m in rte if m == BASELINE]
    found = [
        {
            "recording": name,
            "baseline [%]": own,
            "recommended [%]": rte,
            "ratio": rte / own,
            "role": role,
        }
        for name, own, rte, role in known
        if own and rte is not None
    ]
    return sorted(found, key=lambda row: -row["ratio"])


def _table(rows: Any) -> Any:
    try:
        import pandas as pd
    except ImportError:
        return rows
    return pd.DataFrame(rows).rename(columns=lambda name: name.lstrip("_"))


def tune(
    recordings: Paths,
    odometry: One | Sequence[One] | None = None,
    *,
    config: str | Path | None = None,
    test: Paths = (),
    reading: Reading | None = None,
    points: str | None = None,
    reference: str | Path | None = None,
    trials: int | None = None,
    minutes: float | None = None,
    budget: float | str | None = None,
    portfolio: str | Path | None = None,
    overrides: Sequence[str] = (),
    folder: str | Path | None = None,
    cluster: str | None = None,
    progress: Progress | None = None,
) -> Tuned:
    """Tune an odometry on recordings, and say what to drive, as the command `tune` does.

    The same call again resumes it. In a script, call it below ``if __name__ == "__main__":``. An
    AdaptuneError says what to do about a recording, a reference, an odometry or a setting.

    Parameters
    ----------
    recordings
        Bags, or folders of them; `reading`, ``"one"`` or ``"several"``, says how to read these.
    odometry
        A name, as ``"kiss_icp"`` or ``"my_module:MyIcp"``; such a class; an object of it, whose
        parameters are the baseline, as ``MyIcp(voxel=0.5)``; or a list of these. By default
        ``"gicp"``, with a `config` ``"kiss_icp"``.
    config
        The user's parameter file: the baseline, and all that is not tuned.
    test
        Recordings for the test; by default the last one, or the end of the only one.
    points, reference
        Topics, where not the recording's own; or a reference's file, or ``"estimated"``.
    trials, minutes, budget
        Parameter sets to try, time for all of it, and the CPU time a scan that may be spent:
        milliseconds, or ``"3x"``, times what the baseline takes; by default twice as much.
    overrides, folder, portfolio
        Of the study, as in ``["offline.seed=1"]``; where results go; sets to try first (a file).
    cluster
        Address of a Dask scheduler whose workers run the trials.
    progress
        Called with how far each task is; by default, bars show it.
    """
    if reading not in (None, "one", "several"):
        raise AdaptuneError(f"reading: give 'one' or 'several', not {reading!r}")
    overrides = [overrides] if isinstance(overrides, str) else overrides
    name, about = named_odometry(odometry or ("gicp" if config is None else "kiss_icp"))
    judged, first = (None if one is None else str(one) for one in (reference, portfolio))
    file = None if config is None else Path(config)
    tested, limits = _paths(test), (trials, minutes, budget, first)
    asked = Asked(_paths(recordings), name, points, judged, file, tested, reading, about, *limits)
    with ExitStack() as stack:
        show = progress or stack.enter_context(bars_and_words())
        # It stays where it is if the working folder changes.
        into = Path(folder or _folder(asked)).absolute()
        return tune_asked(asked, overrides, into, cluster, show)


def tune_asked(
    asked: Asked,
    overrides: Sequence[str],
    folder: Path | None,
    cluster: str | None,
    show: Progress,
) -> Tuned:
    """Do what `tune` does of what was asked."""
    check_guarded("tune")
    forget_user_code()
    if asked.reference is not None and Path(asked.reference).is_file():
        asked = asked._replace(reference=str(Path(asked.reference).resolve()))
    if asked.portfolio not in (None, "none"):
        asked = asked._replace(portfolio=str(Path(asked.portfolio).resolve()))
    folder = folder or _folder(asked)
    clock = Stopwatch(folder / ELAPSED, replays=True)
    study, more = write_study(asked, overrides, folder, show)
    before = study.fixed
    with closing(study):
        training = train(study, show, cluster, clock)
        of_each = list[dict[str, Any]]()
        hours, test = study.config.offline.hours, study.config.test
        try:
            if hours is not None:  # what decides comes first, whatever it takes
                replay_modes(study, test, (BASELINE, FIXED), show, training.model)
                show = within(hours, clock, show)
            run_replays(study, study.model_path, show)
            of_each = run_odometries(study, training, show, cluster)
        except OutOfTimeError as why:
            _log.warning("%s", why)
        return Tuned(study, training, *write_comparison(study), more, before, of_each)


class OutOfTimeError(AdaptuneError):
    """Something did not fit into the time."""


LATE = 1.05
"""Times what is allowed, by which all is done, the comparison included."""


def within(hours: float, clock: Stopwatch, show: Progress) -> Progress:
    """Progress with an OutOfTimeError once there is just time for the comparison."""

    def shown(text: str, done: float, of: int, remark: str = "", /) -> None:
        show(text, done, of, remark)
        if clock.hours + FITTING / 3600.0 > LATE * hours and done < of:
            raise OutOfTimeError(f"{text}: does not fit into the time; allow more --minutes")

    return shown


def _paths(given: Paths) -> list[Path]:
    return [Path(given)] if isinstance(given, str | Path) else [Path(path) for path in given]


def _folder(asked: Asked) -> Path:
    recordings, odometry = asked.recordings, asked.odometry
    if not recordings:
        raise AdaptuneError("name a recording: the list is empty")
    stem = plain_name(recordings[0].resolve()) + "_and_more" * (len(recordings) > 1)
    names = (name.strip().replace(":", "_") for name in odometry.split(","))
    others = "+".join(dict.fromkeys(names))
    return Path("runs") / (stem if odometry == "gicp" else f"{stem}_{others}")


def write_comparison(study: OfflineStudy) -> tuple[Comparison, Path]:
    """Compare a study's replays; write tables, verdict and page, also of a study that runs."""
    try:
        found = compare(study)
    except AdaptuneError as error:
        if (study.folder / "study.yaml").exists():
            _log.warning("page: %s", write_study_page(study, f"No comparison: {error}."))
        raise
    write_verdict(study, found)
    return found, write_study_page(study, found)
