import numpy as np
import pytest
from drawn import Drawn
from drives import STUDY

from adaptune.archive import Archive
from adaptune.space import ODOMETRY
from offline.campaign import Campaign
from offline.config import load_study

NAMES = ["one", "two", "three"]


def error(sequence, parameters):
    """By some parameter of the set; the second odometry is a little better."""
    first = next(value for name, value in parameters.items() if name != ODOMETRY)
    best = {"one": 0.9, "two": 1.0, "three": 1.2}[sequence]
    return (1.5 if parameters[ODOMETRY] == "gicp" else 1.2) * (0.5 + abs(np.log(first / best)))


SEVERAL = """\
odometry:
  - {name: gicp, settings: {downsampling: 0.5}}
  - {name: vgicp, settings: {downsampling: 0.5}}
"""


@pytest.fixture
def study_of(study_file, tmp_path):
    """A study of two odometries, in a folder of a given name."""
    path = tmp_path / "several.yaml"
    rest = STUDY[STUDY.index("sequences:") :]
    path.write_text(SEVERAL + rest.replace("bag: ", f"bag: {study_file.parent}/"))

    def load(folder, **given):
        given = {"trials": 32, "initial": 8, "batch": 8} | given
        overrides = [f"offline.{key}={value}" for key, value in given.items()]
        overrides += [f"training=[{', '.join(NAMES)}]", "test=[]"]
        study = load_study(path, overrides, tmp_path / folder)
        study.folder.mkdir(exist_ok=True)
        return study

    return load


def run(study):
    archive = Archive(study.folder / "trials")
    verdicts = Campaign(study, archive, Drawn(error)).run()
    return verdicts, {n: verdict.parameters for n, verdict in verdicts.items()}


@pytest.mark.parametrize("sampler", ["tpe", "random"])
def test_stopped_and_resumed_it_is_the_same(study_of, sampler):
    expected, _ = run(study_of("at-once", sampler=sampler))
    stopped = study_of("stopped", sampler=sampler, trials=20)
    run(stopped)
    rng = np.random.default_rng(0)
    trials = sorted(stopped.folder.glob("trials/*/[0-9]*.npz"))
    for path in rng.choice(trials, len(trials) // 3, replace=False):
        path.unlink()
    again, _ = run(study_of("stopped", sampler=sampler))
    assert again == expected
